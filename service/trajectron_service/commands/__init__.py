"""The subcommands of ``trajectron``, one module each.

A module ``NAME`` defines a function ``NAME`` whose docstring is the help. Modules import heavy
packages inside their functions, so that ``trajectron --help`` is quick.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Annotated

import typer

NAMES = ("serve", "predict", "replay", "simulate", "models", "train", "evaluate")

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


for _name in NAMES:
    if importlib.util.find_spec(f"{__name__}.{_name}"):
        _module = importlib.import_module(f"{__name__}.{_name}")
        app.command(_name)(getattr(_module, _name))
