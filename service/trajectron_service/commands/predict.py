"""``trajectron predict``: a forecast of a recording, without a server."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trajectron_service.commands.options import (
    AllowFewerSamples,
    FramesPerStep,
    Horizon,
    Mode,
    Model,
    RecordingFile,
    Samples,
    Sampling,
    Seed,
    TimeoutS,
    out,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray

    from trajectron_model.data.recording import Recording
    from trajectron_service.commands.recordings import Scene
    from trajectron_service.messages import AgentForecast, Forecast

_LISTED_MODES = 2


def predict(
    file: RecordingFile,
    *,
    at: Annotated[
        float | None,
        typer.Option(
            metavar="TIME",
            help="From this time of the recording on, in seconds; its end by default.",
        ),
    ] = None,
    history: Annotated[
        float,
        typer.Option(min=0.0, metavar="SECONDS", help="How much before it the model sees."),
    ] = 8.0,
    model: Model = None,
    mode: Mode = "full",
    samples: Samples = 20,
    horizon: Horizon = None,
    seed: Seed = None,
    sampling: Sampling = "iid",
    timeout: TimeoutS = None,
    allow_fewer_samples: AllowFewerSamples = False,
    agents: Annotated[
        str | None, typer.Option(metavar="ID,...", help="Only these agents; all by default.")
    ] = None,
    dt: Annotated[
        float,
        typer.Option(min=0.01, max=60.0, metavar="SECONDS", help="Time between two frames."),
    ] = 0.4,
    frames_per_step: FramesPerStep = 10,
    json: Annotated[
        bool, typer.Option("--json", help="Print what `POST /predict` answers, and no table.")
    ] = False,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the scene to a file: .png, .svg, .pdf."),
    ] = None,
) -> None:
    """Forecasts a recording's agents, without a server: a table, JSON or a picture.

    It goes the way of the service's `/predict`, so the same seed gives the same samples.

    Examples:
    `trajectron predict crowd.csv`

    `trajectron predict biwi_eth.txt --at 200 --plot scene.png --seed 7`

    `trajectron predict crowd.csv --mode gmm --agents 3,8 --json`
    """
    from trajectron_model.data.readers import read
    from trajectron_service.commands.offline import forecast_offline
    from trajectron_service.commands.recordings import scenes, step_at
    from trajectron_service.messages import ForecastMode, ForecastOptions
    from trajectron_service.messages import Sampling as SamplingChoice

    if plot is not None:
        _check_format(plot)
    recording = read(file, dt_s=dt, frames_per_step=frames_per_step)
    step = recording.num_steps - 1 if at is None else step_at(recording, at, "--at")
    first = max(step - round(history / recording.dt_s), 0)
    options = ForecastOptions(
        mode=ForecastMode(mode),
        num_samples=samples,
        horizon=horizon,
        seed=seed,
        agents=tuple(agents.split(",")) if agents else None,
        include_modes=None if json and plot is None else True,
        sampling=SamplingChoice(sampling),
        deadline_s=timeout,
        allow_fewer_samples=allow_fewer_samples,
    )
    seen = tuple(scenes(recording, first, step + 1))
    forecast = forecast_offline(model, seen, options, recording.dt_s)
    if plot is not None:
        _plot(plot, forecast, recording, first, step)
    if json:
        _print_json(forecast)
    else:
        _print_table(forecast, recording.name)


def _check_format(path: Path) -> None:
    from matplotlib.backend_bases import FigureCanvasBase

    from trajectron_service.commands.errors import UsageError

    formats = FigureCanvasBase.get_supported_filetypes()
    if path.suffix.lstrip(".").lower() not in formats:
        raise UsageError(f"--plot {path}: the suffix must be one of {', '.join(sorted(formats))}")
    if not path.parent.is_dir():
        raise UsageError(f"--plot {path}: there is no folder {path.parent}")


def _print_json(forecast: Forecast) -> None:
    import orjson

    from trajectron_service.http_encode import forecast_json

    typer.echo(orjson.dumps(forecast_json(forecast), option=orjson.OPT_SERIALIZE_NUMPY).decode())


def _print_table(forecast: Forecast, name: str) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    ahead_s = forecast.time_offsets_s[-1]
    table = Table(
        box=SIMPLE_HEAD,
        pad_edge=False,
        title=f"{name} at {forecast.reference_time:g} s: where in {ahead_s:g} s",
        caption=f"model {forecast.model}, mode {forecast.mode.value}, seed {forecast.seed}. "
        "Metres; seen: steps.",
        title_justify="left",
        caption_justify="left",
    )
    several_types = len({agent.type for agent in forecast.agents}) > 1
    for column in ("agent", "seen", "at", "mean", *("likely mode",) * _LISTED_MODES):
        table.add_column(column, justify="left" if column == "agent" else "right", no_wrap=True)
    for agent in forecast.agents:
        name = f"{agent.id} {agent.type}" if several_types else agent.id
        table.add_row(name, *_cells(agent, forecast.reference_time))
    out.print(table)


def _cells(agent: AgentForecast, reference_time: float) -> tuple[str, ...]:
    import numpy as np

    assert agent.mean is not None  # asked for whenever a table is printed
    away_s = reference_time - agent.last_observed_time
    ago = f", {away_s:.1f} s ago" if away_s > 1e-6 else ""
    probability = agent.mode_probabilities
    ends = agent.mean[:, -1] + np.array([agent.x, agent.y])  # [Z, 2]
    likely = (-probability).argsort()[:_LISTED_MODES].tolist()
    return (
        f"{agent.observations}{ago}",
        _point(agent.x, agent.y),
        _point(*(probability @ ends).tolist()),
        *(f"{probability[z]:.0%}  {_point(*ends[z].tolist())}" for z in likely),
    )


def _point(x: float, y: float) -> str:
    return f"{x:.1f}, {y:.1f}"


def _plot(path: Path, forecast: Forecast, recording: Recording, first: int, step: int) -> None:
    """Draws the histories that the model saw, the forecast, and what came, if it is known."""
    from trajectron_service.commands.recordings import scenes
    from trajectron_service.plotting import draw

    horizon = len(forecast.time_offsets_s)
    end = min(step + 1 + horizon, recording.num_steps)
    sampled = forecast.agents[0].samples if forecast.agents else None
    drawn = "no samples" if sampled is None else f"{len(sampled)} samples"
    draw(
        path,
        forecast,
        _paths(scenes(recording, first, step + 1)),
        futures=_paths(scenes(recording, step + 1, end)),
        title=f"{recording.name} at {forecast.reference_time:g} s, "
        f"{forecast.time_offsets_s[-1]:g} s ahead\n"
        f"model {forecast.model}, {forecast.mode.value}, {drawn} an agent",
    )


def _paths(seen: Iterable[Scene]) -> dict[str, NDArray[np.float64]]:
    """[T, 2] positions by agent id, oldest first."""
    import numpy as np

    places: dict[str, list[tuple[float, float]]] = {}
    for scene in seen:
        for agent in scene.agents:
            places.setdefault(agent.id, []).append((agent.x, agent.y))
    return {name: np.array(points) for name, points in places.items()}
