"""``trajectron load``: simulated crowds at their own pace, against a running service."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from trajectron_service.commands.options import (
    AllowFewerSamples,
    Horizon,
    Mode,
    Samples,
    TimeoutS,
    out,
)

if TYPE_CHECKING:
    from trajectron_service.commands.loading import LoadPlan, LoadReport


def load(
    *,
    server: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Where the service answers gRPC.")
    ] = "127.0.0.1:50051",
    http: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Call over HTTP instead, such as http://127.0.0.1:8000."),
    ] = None,
    sessions: Annotated[int, typer.Option(min=1, max=20_000, help="Sessions at once.")] = 8,
    agents: Annotated[int, typer.Option(min=1, max=2000, help="Agents in each, about.")] = 8,
    rate: Annotated[
        float, typer.Option(min=0.1, max=50.0, help="Frames a second of each session.")
    ] = 2.5,
    seconds: Annotated[
        float, typer.Option(min=0.1, max=3600.0, help="For how long each session sends.")
    ] = 10.0,
    ramp: Annotated[
        float | None,
        typer.Option(min=0.0, help="Seconds within which all have begun; by default one interval."),
    ] = None,
    deadline: Annotated[
        float | None,
        typer.Option(min=0.001, help="Seconds; later is a miss. By default one interval."),
    ] = None,
    mode: Mode = "gmm",
    samples: Samples = 20,
    timeout: TimeoutS = None,
    allow_fewer_samples: AllowFewerSamples = False,
    horizon: Horizon = None,
    model: Annotated[
        str | None, typer.Option(metavar="NAME", help="A model that the service runs.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the crowds.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Figures as JSON.")] = False,
) -> None:
    """Loads a running service with sessions; says what was answered, how fast, and what was not.

    Every session sends its frames when they are due, whether or not those before are answered;
    latencies count from when a frame was due.

    Examples:
    `trajectron load --sessions 64 --agents 8 --rate 4 --seconds 15`

    `trajectron load --http http://127.0.0.1:8000 --sessions 4 --mode full --samples 100`
    """
    import asyncio

    from trajectron_client import ForecastOptions
    from trajectron_service.commands.loading import LoadPlan

    options = ForecastOptions(
        mode=mode,
        num_samples=samples,
        deadline_s=timeout,
        allow_fewer_samples=allow_fewer_samples,
    )
    if horizon is not None:
        options["horizon"] = horizon
    interval_s = 1.0 / rate
    plan = LoadPlan(
        sessions=sessions,
        agents=agents,
        rate_hz=rate,
        seconds=seconds,
        ramp_s=interval_s if ramp is None else ramp,
        deadline_s=interval_s if deadline is None else deadline,
        forecast=options,
        model=model,
        seed=seed,
    )
    report = asyncio.run(_send(plan, server, http))
    if json:
        import orjson

        typer.echo(orjson.dumps(report.to_json(), option=orjson.OPT_INDENT_2).decode())
    else:
        _print(plan, report)
    if report.lost or report.broken:
        raise typer.Exit(1)


async def _send(plan: LoadPlan, server: str, http: str | None) -> LoadReport:
    from trajectron_client import Access, AsyncClient, AsyncHttpClient
    from trajectron_service.commands.loading import send_over_grpc, send_over_http

    access = Access.from_environment()
    if http is None:
        async with AsyncClient(server, access=access) as client:
            return await send_over_grpc(client, plan)
    async with AsyncHttpClient(http, access=access) as caller:
        return await send_over_http(caller, plan)


def _print(plan: LoadPlan, report: LoadReport) -> None:
    from rich.table import Table

    figures = report.to_json()
    table = Table(title="load", title_justify="left", show_header=False)
    table.add_row("sessions", f"{plan.sessions} x {plan.agents} agents, {plan.rate_hz:g} a second")
    table.add_row("frames", f"{report.sent} in {report.seconds:.1f} s")
    table.add_row("a second", f"{figures['sent_per_s']:.1f}")
    table.add_row("forecasts", f"{report.forecasts}")
    table.add_row("a second", f"{figures['forecasts_per_s']:.1f}")
    table.add_row(f"after {plan.deadline_s:g} s", f"{report.late}")
    for reason, count in report.refusals.most_common():
        table.add_row(f"  {reason}", f"{count}")
    for reason, count in report.broken.most_common():
        table.add_row(f"  sessions broken: {reason}", f"{count}")
    table.add_row("lost", f"{report.lost}")
    latency = "   ".join(f"{name} {ms:.1f}" for name, ms in figures["latency_ms"].items())
    table.add_row("latency, ms", latency or "none")
    out.print(table)
