"""Readers of recordings: ETH/UCY text, plain CSV, ApolloScape.

Every reader raises `DataError`, ``FILE:LINE: reason``, for what it cannot read: a wrong number
of columns, something that is not a finite number, an agent twice at one time, an unknown
header, an empty file. Rows may stand in any order.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trajectron_model.data.errors import DataError
from trajectron_model.data.parsing import (
    CSV_COLUMNS,
    Rows,
    agents_of,
    csv_rows,
    load,
    whitespace_rows,
)
from trajectron_model.data.recording import Recording
from trajectron_model.data.resampling import MAX_GAP_S, MAX_STEPS, GridRows, resample

PEDESTRIAN = "pedestrian"
APOLLOSCAPE_DT_S = 0.5
APOLLOSCAPE_TYPES = {1: "vehicle", 2: "vehicle", 3: "pedestrian", 4: "cyclist"}
"""Small and big vehicles, pedestrians, cyclists and motorcyclists; 5 (other) is left out."""

_APOLLOSCAPE_OTHER = 5
_ETH_UCY_COLUMNS = 4
_APOLLOSCAPE_COLUMNS = 10


def read_eth_ucy(
    path: str | Path, *, frames_per_step: int = 10, dt_s: float = 0.4, agent_type: str = PEDESTRIAN
) -> Recording:
    """A recording in the text format of ETH/UCY: frame, id, x, y, split by tabs or spaces.

    Time 0 is frame 0, so step 0 is at ``first frame / frames_per_step * dt_s``.

    Args:
        frames_per_step: frames between two steps of the file. A frame off this grid is an
            error: the format does not say how long a frame is, so nothing is resampled here.
        dt_s: seconds between two steps.
        agent_type: of all agents; the format has none.

    Raises:
        DataError: as the module says, or a frame that is not on the grid.
    """
    path = Path(path)
    text, sha256 = load(path)
    rows = whitespace_rows(path, text, _ETH_UCY_COLUMNS, type_column=None, only_type=agent_type)
    first_frame = rows.time.min()
    steps = (rows.time - first_frame) / frames_per_step
    off_grid = np.flatnonzero(steps != np.rint(steps))
    if len(off_grid):
        raise DataError(
            path,
            int(rows.line[off_grid[0]]),
            f"frame {rows.time[off_grid[0]]:g} is not a whole number of steps of "
            f"{frames_per_step} frames after frame {first_frame:g}; "
            "say how many frames a step has, or use CSV with times in seconds",
        )
    _check_length(path, rows, float(steps.max()))
    start_time_s = float(first_frame) * dt_s / frames_per_step
    ids, types, agent = agents_of(path, rows)
    grid = GridRows(steps.astype(np.int64), agent, rows.position)
    return _recording(path, sha256, dt_s, start_time_s, ids, types, grid)


def read_csv(path: str | Path, dt_s: float = 0.4, *, max_gap_s: float = MAX_GAP_S) -> Recording:
    """A recording in CSV with the header ``time,id,type,x,y``, put onto a grid of ``dt_s``.

    Times are seconds at any rate, regular or not; the grid begins at the earliest. Between two
    observations of an agent at most ``max_gap_s`` apart its position is interpolated; across
    longer gaps, before its first and after its last observation it is absent.

    Raises:
        DataError: as the module says, an agent that changes type, or observations so sparse
            that none can be put on the grid.
    """
    path = Path(path)
    text, sha256 = load(path)
    return _resampled(path, sha256, csv_rows(path, text), dt_s, max_gap_s)


def read_apolloscape(
    path: str | Path,
    *,
    dt_s: float = APOLLOSCAPE_DT_S,
    include_other: bool = False,
    max_gap_s: float = MAX_GAP_S,
) -> Recording:
    """An ApolloScape trajectory file: 10 columns, a frame each 0.5 s (Ma et al., AAAI 2019).

    Args:
        dt_s: at 0.5 rows are taken as they are, so an agent missing from a frame is absent;
            at any other value they are interpolated as in `read_csv`.
        include_other: whether type 5 is kept, as ``other``.

    Raises:
        DataError: as the module says, an unknown type or an agent that changes type.
    """
    path = Path(path)
    text, sha256 = load(path)
    rows = whitespace_rows(path, text, _APOLLOSCAPE_COLUMNS, type_column=2, only_type="")
    fractional = np.flatnonzero(rows.time != np.rint(rows.time))
    if len(fractional):
        raise DataError(path, int(rows.line[fractional[0]]), "the frame must be a whole number")
    rows = _named_types(path, rows, include_other)
    rows = Rows(rows.line, rows.time * APOLLOSCAPE_DT_S, rows.id, rows.type, rows.position)
    max_gap_s = 0.0 if dt_s == APOLLOSCAPE_DT_S else max_gap_s
    return _resampled(path, sha256, rows, dt_s, max_gap_s)


def read(path: str | Path, *, dt_s: float = 0.4, frames_per_step: int = 10) -> Recording:
    """A recording in whichever of the three formats its first line shows.

    Commas mean CSV, four columns ETH/UCY text, ten ApolloScape (resampled to ``dt_s``).

    Args:
        dt_s: seconds between two steps.
        frames_per_step: for ETH/UCY text, see `read_eth_ucy`.

    Raises:
        DataError: none of them, or as the reader of that format says.
    """
    path = Path(path)
    text, _ = load(path)
    line, first = next((n, t) for n, t in enumerate(text.splitlines(), start=1) if t.strip())
    if "," in first:
        return read_csv(path, dt_s)
    columns = len(first.split())
    if columns == _ETH_UCY_COLUMNS:
        return read_eth_ucy(path, dt_s=dt_s, frames_per_step=frames_per_step)
    if columns == _APOLLOSCAPE_COLUMNS:
        return read_apolloscape(path, dt_s=dt_s)
    raise DataError(
        path,
        line,
        f"{columns} columns; expected the CSV header {','.join(CSV_COLUMNS)}, or the "
        f"{_ETH_UCY_COLUMNS} columns of ETH/UCY text, or the {_APOLLOSCAPE_COLUMNS} of ApolloScape",
    )


def _named_types(path: Path, rows: Rows, include_other: bool) -> Rows:
    """ApolloScape's type numbers as names; rows of type 5 dropped unless asked for."""
    names = {f"{number}": name for number, name in APOLLOSCAPE_TYPES.items()}
    names[f"{_APOLLOSCAPE_OTHER}"] = "other"
    for line, type_ in zip(rows.line.tolist(), rows.type, strict=True):
        if type_ not in names:
            raise DataError(path, line, f"type is {type_}; expected 1 to 5")
    types = [names[type_] for type_ in rows.type]
    kept = [n for n, name in enumerate(types) if include_other or name != "other"]
    if not kept:
        raise DataError(path, None, "there are only agents of type 5 (other)")
    return Rows(
        rows.line[kept],
        rows.time[kept],
        [rows.id[n] for n in kept],
        [types[n] for n in kept],
        rows.position[kept],
    )


def _resampled(path: Path, sha256: str, rows: Rows, dt_s: float, max_gap_s: float) -> Recording:
    origin_s = float(rows.time.min())
    _check_length(path, rows, (float(rows.time.max()) - origin_s) / dt_s)
    ids, types, agent = agents_of(path, rows)
    grid = resample(
        rows.time, agent, rows.position, origin_s=origin_s, dt_s=dt_s, max_gap_s=max_gap_s
    )
    return _recording(path, sha256, dt_s, origin_s, ids, types, grid)


def _check_length(path: Path, rows: Rows, steps: float) -> None:
    if steps >= MAX_STEPS:
        reason = f"{steps:.3g} steps after the first row; at most {MAX_STEPS} fit a recording"
        raise DataError(path, int(rows.line[rows.time.argmax()]), reason)


def _recording(
    path: Path,
    sha256: str,
    dt_s: float,
    start_time_s: float,
    ids: tuple[str, ...],
    types: tuple[str, ...],
    grid: GridRows,
) -> Recording:
    """The recording of the agents that have rows on the grid."""
    kept, agent = np.unique(grid.agent, return_inverse=True)
    return Recording.from_rows(
        name=path.stem,
        dt_s=dt_s,
        start_time_s=start_time_s,
        ids=[ids[index] for index in kept],
        types=[types[index] for index in kept],
        step=grid.step,
        agent=agent,
        position=grid.position,
        source_sha256=sha256,
    )
