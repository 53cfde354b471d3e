"""``trajectron models``: the models at hand, where they come from and how good they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import typer

from trajectron_service.commands.options import out
from trajectron_service.messages import ModelInfo

_TABLE_WIDTH = 120
_HASH_LETTERS = 8
_JUDGED_SAMPLES = 20


def models(
    which: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME|PATH]...", help="These models; all bundled ones by default."),
    ] = None,
    *,
    json: Annotated[
        bool, typer.Option("--json", help="Print what `GET /v1/models` answers, provenance too.")
    ] = False,
) -> None:
    """Lists models with their provenance and figures.

    The figures are of the recordings' validation parts, on which a model was selected, and
    of the test set that a leave-one-out model was kept from (`trajectron evaluate`).

    Examples:
    `trajectron models`

    `trajectron models eth_ucy runs/mine --json`
    """
    from trajectron_model import registry

    infos = [_info(name) for name in which or registry.names()]
    if json:
        _print_json(infos)
    else:
        _print_table(infos)


def _info(name_or_path: str) -> ModelInfo:
    from trajectron_model import kernels, registry

    description = registry.describe(name_or_path)
    config = description.config
    return ModelInfo(
        name=description.name,
        hash=description.sha256,
        agent_types=config.node_types,
        dt_s=config.dt_s,
        horizon=config.horizon,
        latent_values=config.latent_values,
        is_default=name_or_path == registry.DEFAULT,
        provenance=description.provenance,
        kernels=kernels.in_use(),
    )


def _print_json(infos: Sequence[ModelInfo]) -> None:
    import orjson

    from trajectron_service.http_encode import model_json

    typer.echo(orjson.dumps({"models": [model_json(info) for info in infos]}).decode())


def _print_table(infos: Sequence[ModelInfo]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(
        box=SIMPLE_HEAD,
        caption="*: the default. ADE/FDE: best of 20 samples per agent, metres.",
        caption_justify="left",
    )
    for column in ("model", "steps", "modes", "validation", "test", "sha256"):
        table.add_column(column, no_wrap=True)
    for column in ("agents", "trained on"):
        table.add_column(column, min_width=14)
    for info in infos:
        table.add_row(
            f"{info.name}{'*' if info.is_default else ''}",
            f"{info.horizon} x {info.dt_s:g} s",
            str(info.latent_values),
            _validation_figures(info.provenance),
            _test_figures(info.provenance),
            info.hash[:_HASH_LETTERS],
            ", ".join(info.agent_types),
            ", ".join(_recordings(info.provenance)) or "not said",
        )
    # On a narrower screen lines wrap: names and figures cut short could be any of several.
    Console(width=max(out.width, _TABLE_WIDTH), soft_wrap=True).print(table)


def _validation_figures(provenance: Mapping[str, object]) -> str:
    """Best of 20 on validation data, where the provenance has it."""
    figures = _mapping(_mapping(provenance.get("selected")).get("validation_figures"))
    return _errors(figures.get("min_ade_20"), figures.get("min_fde_20")) or "not said"


def _test_figures(provenance: Mapping[str, object]) -> str:
    """Best of 20 on the test set, where the model was judged on one."""
    best_of = _mapping(_mapping(provenance.get("evaluation")).get("errors_m")).get("best_of")
    for row in best_of if isinstance(best_of, list) else ():
        if _mapping(row).get("n") == _JUDGED_SAMPLES:
            errors = _mapping(_mapping(row).get("per_agent"))
            return _errors(errors.get("ade_m"), errors.get("fde_m"))
    return ""


def _errors(ade: object, fde: object) -> str:
    known = isinstance(ade, float) and isinstance(fde, float)
    return f"{ade:.3f}/{fde:.3f}" if known else ""


def _recordings(provenance: Mapping[str, object]) -> list[str]:
    recordings = _mapping(provenance.get("training")).get("recordings")
    if not isinstance(recordings, list):
        return []
    return [str(_mapping(recording).get("name", "?")) for recording in recordings]


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}
