"""``trajectron serve``: the service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def serve(
    *,
    model: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME|PATH",
            help="A bundled model (see `trajectron models`) or a checkpoint file; repeat it for "
            "several, the first answers requests that name none.",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A TOML file with any of the settings."),
    ] = None,
    host: Annotated[
        str | None, typer.Option(help="The address to bind; 127.0.0.1 by default.")
    ] = None,
    http_port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="8000 by default; 0 picks a free one."),
    ] = None,
    grpc_port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="50051 by default; 0 picks a free one."),
    ] = None,
    metrics_port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Metrics and probes there, not on the HTTP port."),
    ] = None,
    tokens: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Who may call, see `trajectron token new --help`."),
    ] = None,
    insecure: Annotated[
        bool | None,
        typer.Option("--insecure", help="Serve other machines although nothing protects it."),
    ] = None,
    log_level: Annotated[
        Literal["debug", "info", "warning", "error"] | None,
        typer.Option(help="`info` by default."),
    ] = None,
    log_format: Annotated[
        Literal["console", "json"] | None, typer.Option(help="`console` by default.")
    ] = None,
) -> None:
    """Answers over HTTP and gRPC until SIGTERM or Ctrl-C, then finishes the work in hand.

    Every setting can also come from the environment, as `TRAJECTRON_HTTP_PORT`, or from the
    file; flags win over the environment, which wins over the file. The HTTP API is documented
    at `/docs`, metrics are at `/metrics`.

    Examples:
    `trajectron serve`

    `trajectron serve --model runs/mine --model eth_ucy --http-port 9000`

    `TRAJECTRON_MAX_SESSIONS=100 trajectron serve --config service.toml --log-format json`
    """
    from trajectron_service import lifecycle, settings

    lifecycle.serve(
        settings.load(
            models=tuple(model) if model else None,
            config=config,
            host=host,
            http_port=http_port,
            grpc_port=grpc_port,
            metrics_port=metrics_port,
            tokens=tokens,
            insecure=insecure,
            log_level=log_level,
            log_format=log_format,
        )
    )
