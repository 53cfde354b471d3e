"""The report of `benchmarks.paper`: what it measured, section by section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks import modes, published, runtime
from benchmarks.published import Published
from trajectron_model.data.recording import Recording
from trajectron_model.evaluation import exhibits, figures, report
from trajectron_model.evaluation.contenders import STRATIFIED
from trajectron_model.evaluation.document import (
    Cell,
    Document,
    Figure,
    Picture,
    Section,
    Table,
    cell,
)
from trajectron_model.evaluation.exhibits import Metric
from trajectron_model.evaluation.figures import Curve, Style
from trajectron_model.evaluation.pictures import AllScores
from trajectron_model.evaluation.results import Evaluation, Row
from trajectron_model.trajectron import Trajectron

Exhibit = Table | Picture
_BEST_OF = (100, 20, 5, 1)
_ABOUT = (
    "The figures and tables of Ivanovic & Pavone, “The Trajectron” (ICCV 2019), for our models and "
    "for every baseline, trained by us on the same leave-one-out splits, run through one harness "
    "on the same windows with the same causal inputs. Small print gives 95% bootstrap intervals "
    "over windows; the best of each column is marked. Published rows, in italics, are as their "
    "authors report them and are not ranked."
)
_NOISE = (
    "Gaussian noise on every observed coordinate of the protocol sgan; the truth stays clean. The "
    "recordings are smooth splines, real trackers are not. A recording is jittered once: windows "
    "that overlap see the same noise."
)
_TEN_HERTZ = (
    "At 10 Hz a session that was told the interval keeps four interleaved chains of states, each "
    "stepped every 0.4 s, and a forecast starts from the newest frame's chain. Where the noise is "
    "independent from frame to frame, such a chain sees what is judged here: these figures are "
    "those of 10 Hz as well."
)
_REPRODUCTION = (
    "The paper's model and training, under the paper's conditions, to see whether they give its "
    "Table 1: .34/.67 for the mean of Full."
)
_LEAK = (
    "The leaking rows have the future in their inputs: central differences over whole tracks, "
    "statistics of the test set, edges that fade in before they exist. They reproduce the "
    "conditions of the published Table 1 and must not be compared with causal rows; the causal "
    "row stands beside them. No leaking model can be served."
)


@dataclass(frozen=True)
class Results:
    """All that was measured.

    Attributes:
        ours: the entry of our model.
        evaluations: by name: ``table-1``, ``sgan``, ``streaming``, ``jitter-N-cm``, ``leaky``.
        scores: of the agents of ``table-1``.
        timings: of every set.
        recordings, models: of every set, to draw scenes of.
        missing: entries that could not be judged, and why.
        quick: whether a few windows and samples were all.
    """

    ours: str
    evaluations: Mapping[str, Evaluation]
    scores: AllScores
    timings: Sequence[runtime.SetTimings]
    recordings: Mapping[str, Sequence[Recording]]
    models: Mapping[str, Trajectron]
    missing: Mapping[str, str]
    quick: bool
    style: Mapping[str, Style] = field(init=False)

    def __post_init__(self) -> None:
        style = exhibits.entry_styles(self.evaluations.values())
        object.__setattr__(self, "style", style)


def document(results: Results) -> Document:
    """The whole report."""
    sections = (
        boxplots(results),
        table_1(results),
        likelihood(results),
        table_2(results),
        point_forecasts(results),
        best_of(results),
        report.calibration(_of_independent_samples(results), results.style),
        few_observations(results),
        noise(results),
        behaviour(results),
        leaky(results),
        *(
            _renamed(report.what_was_judged(one), f"What was judged: {name}")
            for name, one in results.evaluations.items()
            if not name.startswith("jitter")
        ),
        Section("How to read this", report.caveats(results.evaluations["sgan"])),
    )
    return Document(
        "The Trajectron and its baselines, measured again",
        (
            _ABOUT,
            *_warnings(results),
        ),
        _facts(results),
        tuple(one for one in sections if one.contents or one.paragraphs),
    )


def _warnings(results: Results) -> list[str]:
    found = []
    if results.quick:
        found.append(
            "This is a shortened run: a few windows and samples, to see that all works. None of "
            "its figures may be quoted."
        )
    if results.missing:
        named = ", ".join(exhibits.title_of(entry) for entry in results.missing)
        found.append(f"Missing: {named}. The first facts below say why.")
    return found


def _facts(results: Results) -> dict[str, str]:
    found = {f"Missing: {exhibits.title_of(entry)}": why for entry, why in results.missing.items()}
    for name, of in results.evaluations.items():
        plan = of.fingerprint.plan
        sets = ", ".join(
            f"{exhibits.set_title(one.test_set)} {one.windows}/{one.agents}"
            for one in of.fingerprint.sets
        )
        jitter = f", {100 * plan.jitter_m:g} cm of jitter" if plan.jitter_m else ""
        found[name] = (
            f"protocol {plan.protocol}{jitter}, {plan.samples} samples, seed {plan.seed}; "
            f"windows/agents: {sets}"
        )
    return found


def boxplots(results: Results) -> Section:
    """The paper's figure of ADE and FDE."""
    of = results.evaluations["table-1"]
    found: list[Exhibit | None] = [
        report.boxplot(of, results.scores, error, results.style)
        for error in (report.ADE, report.FDE)
    ]
    found += [
        exhibits.t_tests(of, metric, f"{error} of one sample, m", reference=results.ours)
        for metric, error in (("min_ade_1", "ADE"), ("min_fde_1", "FDE"))
    ]
    drawn = of.fingerprint.plan.samples
    about = (
        f"Protocol paper: everyone present at the newest observed step and the next, {drawn} "
        "samples each. The t-tests are on mean errors of samples, two-tailed, as in the paper."
    )
    return Section("ADE and FDE of all samples", (about,), _there(found))


def table_1(results: Results) -> Section:
    """The paper's Table 1: best of 100, joint over the scene."""
    of = results.evaluations["table-1"]
    n = _most(of)
    table = exhibits.by_set(
        of,
        [Metric(f"joint_ade_{n}", "ADE"), Metric(f"joint_fde_{n}", "FDE")],
        f"Best of {n} samples, joint over the scene, protocol paper: ADE / FDE in metres",
        "Published rows were judged with at most 100 windows a set drawn by their authors; the "
        "leaking ones had the future in their inputs.",
    )
    about = (
        "One sample index serves all agents of a window: the one with the lowest error summed over "
        "them, separately for ADE and FDE. The state is empty at each chunk's start. More samples "
        f"than {n} are cut into groups of {n}, whose figures are averaged."
    )
    test = exhibits.t_tests(
        of, f"joint_ade_{n}", f"ADE of the best of {n}, joint, m", reference=results.ours
    )
    return Section(
        f"Table 1: best of {n}",
        (about,),
        _there([table and beside(table, published.TABLE_1, _sets(of)), test]),
    )


def likelihood(results: Results) -> Section:
    """The paper's figures of the KDE likelihood, by set and by step, and its t-tests."""
    of = results.evaluations["table-1"]
    found: list[Exhibit | None] = [*report.kde(of, results.style)]
    for metric, title in (
        ("nll_kde", "KDE negative log likelihood per step, nats"),
        ("nll_mixture", "Negative log likelihood of the analytic mixture per step, nats"),
        ("nll_exact", "Exact negative log likelihood of the whole trajectory, nats"),
    ):
        found.append(exhibits.by_set(of, [Metric(metric, metric, 2)], title))
    found.append(
        exhibits.t_tests(
            of, "nll_kde", "KDE negative log likelihood", reference=results.ours, places=2
        )
    )
    about = (
        f"Kernel density estimates (scipy's gaussian_kde with its defaults) of "
        f"{of.fingerprint.kde_samples} positions a step, log density floored at −20, over agents "
        "with as little as one past step. Entries with a single trajectory have no density: they "
        "stand at the floor, and in no figure. The analytic mixture needs no samples."
    )
    return Section("Likelihood of what came", (about,), _there(found))


def table_2(results: Results) -> Section:
    """The paper's Table 2: seconds for 200 samples of all agents of a scene."""
    timings = results.timings
    names = list(dict.fromkeys(name for one in timings for name in one.timings))
    best = [
        min((t.median_s for name, t in one.timings.items() if "gmm" not in name), default=None)
        for one in timings
    ]
    rows: list[tuple[Cell, ...]] = [
        (
            cell(name),
            *(
                _timing(one.timings.get(name), least)
                for one, least in zip(timings, best, strict=True)
            ),
        )
        for name in names
    ]
    places = [_place(one.test_set) for one in timings]
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
    note = "Small print: least to largest of the repeats; ×: seconds over those of Social GAN in "
    note += "one batched call, in the same repeat. Published rows are of another machine."
    table = Table(
        f"Seconds for {runtime.SAMPLES} samples of all agents in sight, {runtime.HORIZON} steps",
        header,
        tuple(rows),
        note,
        frozenset(muted),
    )
    about = (
        f"One thread of {runtime.processor()}, all in the same run, in turn. Ours observes one "
        "frame and forecasts, as it does in service, where the state of the scene is at hand; "
        "Social GAN keeps no state and starts from 8 frames, as does our last row. The published "
        "comparison is of 200 calls of one sample; one batched call is the rival to beat."
    )
    return Section("Table 2: runtime", (about,), (table,))


def _timing(timing: runtime.Timing | None, least: float | None) -> Cell:
    if timing is None:
        return cell("–")
    ratio = "" if timing.ratio is None else f", ×{timing.ratio:.2f}"
    spread = f"{timing.low_s:.3g} to {timing.high_s:.3g}{ratio}"
    return (Figure(f"{timing.median_s:.3g}", spread, best=timing.median_s == least),)


def point_forecasts(results: Results) -> Section:
    """The protocol `sgan`, point forecasts in both forms."""
    of = _of_independent_samples(results)
    section = report.errors(of, None, results.style)
    first, *others = section.contents
    assert isinstance(first, Table)
    return Section(
        "Point forecasts, protocol sgan",
        section.paragraphs,
        (beside(first, published.POINT, _sets(of)), *others),
    )


def _of_independent_samples(results: Results) -> Evaluation:
    """The protocol `sgan` without the row of stratified samples, which shares its distribution."""
    of = results.evaluations["sgan"]
    rows = tuple(row for row in of.rows if not row.name.endswith(f"@{STRATIFIED}"))
    return replace(of, rows=rows)


def best_of(results: Results) -> Section:
    """The protocol `sgan`, best-of-N in both forms, published rows beside."""
    of = results.evaluations["sgan"]
    section = report.best_of(of, results.style)
    published_rows = {
        "Best of 20, per agent": published.BEST_OF_20,
        "Best of 20, joint": published.JOINT_20,
    }
    contents: list[Exhibit] = []
    for one in section.contents:
        rows = next(
            (rows for title, rows in published_rows.items() if one.caption.startswith(title)), None
        )
        contents.append(beside(one, rows, _sets(of)) if rows and isinstance(one, Table) else one)
    return Section("Best of N, protocol sgan", section.paragraphs, tuple(contents))


def few_observations(results: Results) -> Section:
    """The protocol `streaming`, by the number of observations."""
    section = report.observations(results.evaluations["streaming"], results.style)
    about = (
        "Protocol streaming: each recording is streamed once from its first frame, as the service "
        "does it; at every frame everyone in it is judged over the steps of their future that "
        "exist. Agents are grouped by the steps at which they had been seen since they last "
        "(re)appeared."
    )
    return Section("Few observations, protocol streaming", (about,), section.contents)


def noise(results: Results) -> Section:
    """Accuracy and coverage under jitter."""
    jittered = {
        100 * one.fingerprint.plan.jitter_m: one
        for name, one in results.evaluations.items()
        if name.startswith("jitter")
    }
    shown = {
        "ADE of the mean over all modes, m": Metric("ade_mean", "ADE"),
        "FDE of the mean over all modes, m": Metric("fde_mean", "FDE"),
        "ADE of the best of 20, m": Metric("min_ade_20", "best of 20, ADE"),
        "coverage of the 80% regions, %": Metric("coverage_80", "80% coverage", 1, 100.0, 0.8),
    }
    tables: list[Exhibit] = []
    panels: dict[str, dict[str, Curve]] = {}
    for title, metric in shown.items():
        table = _by_jitter(jittered, metric, f"{title}, mean over sets, by jitter")
        if table is None:
            continue
        tables.append(table)
        panels[title] = _jitter_curves(jittered, metric)
    pictures = [
        _jitter_picture(name, title, panels[title], results.style)
        for name, title in (
            ("jitter-ade", "ADE of the mean over all modes, m"),
            ("jitter-coverage", "coverage of the 80% regions, %"),
        )
        if panels.get(title)
    ]
    return Section("Noise", (_NOISE, _TEN_HERTZ), (*tables, *pictures))


def _by_jitter(jittered: Mapping[float, Evaluation], metric: Metric, caption: str) -> Table | None:
    """Entries by jitter: the columns of several evaluations side by side."""
    columns: list[tuple[str, Table]] = []
    for jitter_cm, of in jittered.items():
        one = exhibits.by_metric(of, [metric], caption)
        if one is None:
            return None
        columns.append((f"{jitter_cm:g} cm", one))
    names = [row[0] for row in columns[0][1].rows]
    if any([row[0] for row in table.rows] != names for _, table in columns):
        raise ValueError("the evaluations under jitter have different entries")
    rows = tuple(
        (name, *(table.rows[place][1] for _, table in columns)) for place, name in enumerate(names)
    )
    return Table(caption, ("", *(title for title, _ in columns)), rows, "", columns[0][1].muted)


def _jitter_curves(jittered: Mapping[float, Evaluation], metric: Metric) -> dict[str, Curve]:
    found: dict[str, list[tuple[float, float, float, float]]] = {}
    for jitter_cm, of in jittered.items():
        for row in of.rows:
            one = row.mean.metrics.get(metric.name)
            if one is not None and (metric.target is None or exhibits.has_spread(row)):
                value, low, high = (metric.factor * v for v in (one.value, one.low, one.high))
                found.setdefault(exhibits.title_of(row.name), []).append(
                    (jitter_cm, value, low, high)
                )
    return {name: Curve(*np.array(points).T) for name, points in found.items()}


def _jitter_picture(
    name: str, title: str, found: Mapping[str, Curve], style: Mapping[str, Style]
) -> Picture:
    ticks = sorted({float(x) for curve in found.values() for x in np.atleast_1d(curve.x)})
    drawn = figures.curves(
        {exhibits.MEAN: found}, style, label=title, below="jitter, cm", ticks=ticks
    )
    caption = f"{title[0].upper()}{title[1:]} by jitter, mean over sets, with 95% bands."
    return Picture(name, caption, figures.svg(drawn).encode())


def behaviour(results: Results) -> Section:
    """The paper's figure of behaviour modes, for one scene of each set."""
    scenes = {}
    for name, recordings in results.recordings.items():
        scene = modes.choose(recordings)
        if scene is not None:
            scenes[exhibits.set_title(name)] = (scene, results.models[name])
    if not scenes:
        return Section("Behaviour modes by latent value")
    picture = Picture(
        "behaviour-modes",
        f"{modes.SAMPLES} samples for each of two walkers, in the colour of the latent value that "
        "each came from; thick lines are the values' means. Observed steps in black, what came "
        "dotted, others grey. Shares are the two walkers' mean probabilities. Each set has a model "
        "of its own, so its values are its own.",
        modes.draw(scenes).encode(),
    )
    about = (
        f"Scenes are chosen by a rule that sees the observed past alone: {modes.RULE}. "
        "Positions are metres from the panel's corner."
    )
    return Section("Behaviour modes by latent value", (about,), (picture,))


def leaky(results: Results) -> Section:
    """The fenced reproduction of Table 1 under the paper's conditions, the causal row beside."""
    of = results.evaluations.get("leaky")
    if of is None:
        return Section("Under the paper's conditions")
    n = _most(of)
    table = exhibits.by_set(
        of,
        [Metric(f"joint_ade_{n}", "ADE"), Metric(f"joint_fde_{n}", "FDE")],
        f"Best of {n} samples, joint over the scene, protocol paper: ADE / FDE in metres",
        "Every seed that was trained is shown. Leaking rows, in italics, are not ranked.",
    )
    rows = [row for row in of.rows if exhibits.fenced(row)]
    about = [_REPRODUCTION]
    if rows and n == 100:
        about.append(_spread(rows, n))
    return Section(
        "Under the paper's conditions: paper-leaky",
        tuple(about),
        _there([table and beside(table, published.TABLE_1[:2], _sets(of))]),
        _LEAK,
    )


def _spread(rows: Sequence[Row], n: int) -> str:
    """The mean over sets of every seed, as a sentence."""
    found = [
        row.mean.metrics[f"joint_{error}_{n}"].value for row in rows for error in ("ade", "fde")
    ]
    ade, fde = np.array(found).reshape(-1, 2).T
    return (
        f"Over {len(rows)} seeds the mean of the sets is {ade.mean():.3f}/{fde.mean():.3f} "
        f"(ADE {ade.min():.3f} to {ade.max():.3f}, FDE {fde.min():.3f} to {fde.max():.3f}), "
        f"{100 * (ade.mean() / 0.34 - 1):+.0f}% and {100 * (fde.mean() / 0.67 - 1):+.0f}% from it."
    )


def beside(table: Table, rows: Sequence[Published], sets: Sequence[str]) -> Table:
    """The table with published rows below, muted; of the sets that are its columns."""
    places = [_place(one) for one in sets]
    if all(place is None for place in places):
        return table
    whole = tuple(sets) == published.SETS
    added = []
    for row in rows:
        cells = [_pair(None if place is None else row.sets[place]) for place in places]
        if len(sets) > 1:
            cells += [_pair(row.mean if whole else None), cell("–")]
        added.append((cell(row.title), *cells))
    muted = range(len(table.rows), len(table.rows) + len(added))
    return Table(
        table.caption, table.header, (*table.rows, *added), table.note, table.muted | set(muted)
    )


def _place(test_set: str) -> int | None:
    return published.SETS.index(test_set) if test_set in published.SETS else None


def _pair(pair: published.Pair) -> Cell:
    return cell("–") if pair is None else tuple(Figure(f"{value:.2f}") for value in pair)


def _sets(of: Evaluation) -> list[str]:
    return [one.test_set for one in of.fingerprint.sets]


def _most(of: Evaluation) -> int:
    """The largest N of best-of-N that there were samples for."""
    return next(n for n in _BEST_OF if n <= of.fingerprint.plan.samples)


def _renamed(section: Section, title: str) -> Section:
    return Section(title, section.paragraphs, section.contents, section.warning)


def _there(found: Sequence[Exhibit | None]) -> tuple[Exhibit, ...]:
    return tuple(one for one in found if one is not None)
