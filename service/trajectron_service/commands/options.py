"""Options that several commands share, and how they print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

# Plain text when piped; nothing that looks like a number is coloured by itself.
out = Console(highlight=False, soft_wrap=True)


RecordingFile = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="A recording: CSV `time,id,type,x,y`, ETH/UCY text, or ApolloScape.",
        exists=True,
        dir_okay=False,
        readable=True,
    ),
]
Model = Annotated[
    str | None,
    typer.Option(
        "--model",
        metavar="NAME|PATH",
        help="A bundled model (see `trajectron models`) or a checkpoint file.",
    ),
]
Mode = Annotated[
    Literal["full", "z_best", "gmm"],
    typer.Option(
        "--mode",
        help="`full`: draw a mode, then a path; `z_best`: paths of the most probable mode; "
        "`gmm`: no sampling, Gaussians of every mode.",
    ),
]
Samples = Annotated[int, typer.Option("--samples", min=1, max=2000, help="Futures per agent.")]
Horizon = Annotated[
    int | None,
    typer.Option("--horizon", min=1, max=60, help="Steps to forecast; the model's own by default."),
]
Seed = Annotated[
    int | None,
    typer.Option("--seed", min=0, help="The same seed gives the same samples; drawn by default."),
]
Sampling = Annotated[
    Literal["iid", "stratified"],
    typer.Option(
        "--sampling",
        help="`iid`: an agent's samples are independent; `stratified`: spread evenly over the "
        "same distribution.",
    ),
]
TimeoutS = Annotated[
    float | None,
    typer.Option(
        "--timeout", min=0.001, help="Seconds to answer in; what would be late is refused."
    ),
]
AllowFewerSamples = Annotated[
    bool,
    typer.Option(
        "--allow-fewer-samples",
        help="Where all samples would be late: the first ones, as many as are in time.",
    ),
]
FramesPerStep = Annotated[
    int,
    typer.Option(
        "--frames-per-step", min=1, help="For ETH/UCY text: frame numbers between two steps."
    ),
]
