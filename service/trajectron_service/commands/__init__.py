"""The subcommands of ``trajectron``, one module each.

A module ``NAME`` defines a function ``NAME`` whose docstring is the help. Modules import heavy
packages inside their functions, so that ``trajectron --help`` is quick.
"""

from __future__ import annotations

from typing import Annotated

import typer

from trajectron_service.commands import (
    evaluate,
    models,
    predict,
    replay,
    serve,
    simulate,
    token,
    train,
    train_baseline,
)

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Forecasts where each agent of a scene goes next: a service, and tools around it.",
    epilog="Start with `trajectron simulate > crowd.csv`, `trajectron predict crowd.csv`, "
    "`trajectron serve`.",
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(version("trajectron-service"))
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Forecasts where each agent of a scene goes next: a service, and tools around it."""


app.command()(serve.serve)
app.command()(predict.predict)
app.command()(replay.replay)
app.command()(simulate.simulate)
app.command()(models.models)
app.command()(train.train)
app.command()(train_baseline.train_baseline)
app.command()(evaluate.evaluate)
app.add_typer(token.token, name="token")
