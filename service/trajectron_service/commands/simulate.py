"""``trajectron simulate``: a crowd to try things with."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TextIO

import typer

if TYPE_CHECKING:
    from trajectron_model.data.recording import Recording


Layout = Literal["corridor", "crossing", "square"]
Format = Literal["csv", "eth-ucy"]


def simulate(
    layout: Annotated[
        Layout, typer.Argument(help="Where they walk: both ways everywhere.")
    ] = "crossing",
    *,
    agents: Annotated[int, typer.Option(min=1, help="How many walk at a time.")] = 20,
    seconds: Annotated[float, typer.Option(min=0.0, max=86_400.0, help="How long.")] = 30.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same crowd.")] = 0,
    dt: Annotated[
        float, typer.Option(min=0.001, max=60.0, metavar="SECONDS", help="Time between two frames.")
    ] = 0.4,
    form: Annotated[
        Format, typer.Option("--format", help="CSV `time,id,type,x,y`, or ETH/UCY text.")
    ] = "csv",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Standard output by default."),
    ] = None,
) -> None:
    """Writes a simulated crowd, walking by social forces (Helbing & Molnár 1995).

    The area grows with the number of agents, so that the density stays.

    Examples:
    `trajectron simulate > crowd.csv`

    `trajectron simulate corridor --agents 200 --seconds 120 --seed 7 -o corridor.csv`

    `trajectron simulate square --format eth-ucy -o square.txt`
    """
    recording = _record(layout, agents, seconds, seed, dt)
    if output is None:
        _write(recording, form, sys.stdout)
        return
    with output.open("w", encoding="utf-8", newline="") as file:
        _write(recording, form, file)


def _record(layout: Layout, agents: int, seconds: float, seed: int, dt_s: float) -> Recording:
    from itertools import islice

    import numpy as np

    from trajectron_model.data.recording import Recording
    from trajectron_model.simulation import Scenario
    from trajectron_model.simulation import simulate as walk

    steps = int(seconds / dt_s + 1e-9) + 1
    frames = list(islice(walk(Scenario(layout), agents, seed=seed, dt_s=dt_s), steps))
    types = {
        name: kind for frame in frames for name, kind in zip(frame.ids, frame.types, strict=True)
    }
    index = {name: number for number, name in enumerate(types)}
    return Recording.from_rows(
        name=layout,
        dt_s=dt_s,
        start_time_s=0.0,
        ids=tuple(types),
        types=tuple(types.values()),
        step=np.repeat(np.arange(steps), [len(frame.ids) for frame in frames]),
        agent=np.array([index[name] for frame in frames for name in frame.ids], dtype=np.int64),
        position=np.concatenate([frame.positions for frame in frames]),
        num_steps=steps,
    )


def _write(recording: Recording, form: Format, file: TextIO) -> None:
    from trajectron_model.data.writers import write_csv, write_eth_ucy

    if form == "csv":
        write_csv(recording, file)
    else:
        write_eth_ucy(recording, file)
