"""``trajectron replay``: streams a recording to a running service."""

from __future__ import annotations

from typing import Annotated

import typer

from trajectron_service.commands.options import (
    AllowFewerSamples,
    FramesPerStep,
    Horizon,
    Mode,
    RecordingFile,
    Samples,
    Sampling,
    Seed,
    TimeoutS,
)


def replay(
    file: RecordingFile,
    *,
    server: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Where the service answers gRPC.")
    ] = "127.0.0.1:50051",
    speed: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="1: at its own rate; 10: ten times faster; 0: each frame as soon as the one "
            "before it is answered.",
        ),
    ] = 1.0,
    start: Annotated[
        float | None, typer.Option(metavar="TIME", help="From this time of the recording on.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="Only this much of it.")] = None,
    dt: Annotated[
        float,
        typer.Option(min=0.01, max=60.0, metavar="SECONDS", help="Time between two frames."),
    ] = 0.4,
    frames_per_step: FramesPerStep = 10,
    session: Annotated[
        str | None,
        typer.Option(
            metavar="ID",
            help="A session to go on with, or to open and leave open; by default a new one that "
            "is closed at the end.",
        ),
    ] = None,
    model: Annotated[
        str | None, typer.Option(metavar="NAME", help="A model that the service runs.")
    ] = None,
    mode: Mode = "gmm",
    samples: Samples = 20,
    horizon: Horizon = None,
    seed: Seed = None,
    sampling: Sampling = "iid",
    timeout: TimeoutS = None,
    allow_fewer_samples: AllowFewerSamples = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Only the summary, no line for each frame.")
    ] = False,
) -> None:
    """Streams a recording to a running service; shows its forecasts and their latency.

    The latency of a frame is the time from sending it to having its forecast.

    Examples:
    `trajectron replay crowd.csv`

    `trajectron replay crowd.csv --speed 0 --quiet`

    `trajectron replay biwi_eth.txt --start 180 --seconds 20 --mode full --samples 100`
    """
    import asyncio

    from trajectron_client import ForecastOptions, SessionOptions
    from trajectron_model.data.readers import read
    from trajectron_service.commands.playback import Playback
    from trajectron_service.commands.recordings import scenes, steps_between

    recording = read(file, dt_s=dt, frames_per_step=frames_per_step)
    first, last = steps_between(recording, start, seconds)
    playback = Playback(
        scenes(recording, first, last),
        interval_s=recording.dt_s / speed if speed else None,
        show_frames=not quiet,
    )
    asyncio.run(
        playback.run(
            server,
            session,
            SessionOptions(model=model, frame_interval_s=recording.dt_s),
            ForecastOptions(
                mode=mode,
                num_samples=samples,
                horizon=horizon,
                seed=seed,
                include_modes=True,
                sampling=sampling,
                deadline_s=timeout,
                allow_fewer_samples=allow_fewer_samples,
            ),
        )
    )
    playback.summarise()
