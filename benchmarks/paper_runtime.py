"""The section of runtimes: the paper's Table 2, on equal terms."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks import published, runtime
from benchmarks.runtime import SetTimings, Timing
from trajectron_model.evaluation import exhibits
from trajectron_model.evaluation.document import Cell, Figure, Section, Table, cell

_OURS, _RIVAL = "Trajectron", "Social GAN"
_NOTE = (
    "Small print: least to largest of the repeats; ×: seconds over those of Social GAN in one "
    "batched call, in the same repeat. Marked: the fastest of Trajectron and Social GAN that draws "
    "the samples. Published rows are of another machine."
)


def _ranked(name: str) -> bool:
    """Whether it is one of the two models of the paper's table, with samples."""
    return name.startswith((_OURS, _RIVAL)) and "gmm" not in name


def section(timings: Sequence[SetTimings]) -> Section:
    """The paper's Table 2: seconds for 200 samples of all agents of a scene."""
    names = list(dict.fromkeys(name for one in timings for name in one.timings))
    names.sort(key=lambda name: (not name.startswith(_OURS), not name.startswith(_RIVAL)))
    best = [
        min((t.median_s for name, t in one.timings.items() if _ranked(name)), default=None)
        for one in timings
    ]
    rows: list[tuple[Cell, ...]] = [
        (
            cell(name),
            *(
                _timing(one.timings.get(name), least if _ranked(name) else None)
                for one, least in zip(timings, best, strict=True)
            ),
        )
        for name in names
    ]
    places = [published.place(one.test_set) for one in timings]
    muted = []
    if None not in places:
        for title, seconds in published.TABLE_2.items():
            muted.append(len(rows))
            rows.append(
                (cell(title), *(cell(f"{seconds[p]:.2f}") for p in places if p is not None))
            )
    header = (
        "",
        *(f"{exhibits.set_title(one.test_set)}, {one.mean_agents:.1f} agents" for one in timings),
    )
    table = Table(
        f"Seconds for {runtime.SAMPLES} samples of all agents in sight, {runtime.HORIZON} steps",
        header,
        tuple(rows),
        _NOTE,
        frozenset(muted),
    )
    about = (
        f"One thread of {runtime.processor()}, all in the same run, in turn. Ours observes one "
        "frame and forecasts, as it does in service, where the state of the scene is at hand; "
        "Social GAN keeps no state and starts from 8 frames, as does our last row. The published "
        "comparison is of 200 calls of one sample; one batched call is the rival to beat."
    )
    return Section("Table 2: runtime", (about,), (table,))


def _timing(timing: Timing | None, least: float | None) -> Cell:
    if timing is None:
        return cell("–")
    ratio = "" if timing.ratio is None else f", ×{timing.ratio:.2f}"
    spread = f"{timing.low_s:.3g} to {timing.high_s:.3g}{ratio}"
    return (Figure(f"{timing.median_s:.3g}", spread, best=timing.median_s == least),)
