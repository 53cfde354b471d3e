"""The report of `benchmarks.paper`: what it measured, section by section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks import modes, paper_noise, paper_runtime, published, runtime
from benchmarks.published import Published
from trajectron_model.data.recording import Recording
from trajectron_model.evaluation import exhibits, report
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
from trajectron_model.evaluation.figures import Style
from trajectron_model.evaluation.pictures import AllScores
from trajectron_model.evaluation.results import Evaluation, Row
from trajectron_model.trajectron import Trajectron

Exhibit = Table | Picture
_BEST_OF = (100, 20, 5, 1)
_ABOUT = (
    "The figures and tables of Ivanovic & Pavone, “The Trajectron” (ICCV 2019), for our models and "
    "for the baselines beside them, trained by us on the same leave-one-out splits, run through "
    "one harness on the same windows with the same causal inputs. Small print gives 95% bootstrap "
    "intervals over windows; the best of each column is marked. Published rows, in italics, are "
    "as their authors report them and are not ranked."
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
        paper_runtime.section(results.timings),
        point_forecasts(results),
        best_of(results),
        report.calibration(_of_independent_samples(results), results.style),
        few_observations(results),
        paper_noise.section(results.evaluations, results.style),
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
    jittered = paper_noise.by_jitter(results.evaluations)
    for name, of in results.evaluations.items():
        plan = of.fingerprint.plan
        if plan.jitter_m:
            continue  # the same windows as without
        sets = ", ".join(
            f"{exhibits.set_title(one.test_set)} {one.windows}/{one.agents}"
            for one in of.fingerprint.sets
        )
        title, noise = name, ""
        if of in jittered.values():
            title, noise = "jitter", f", noise of {', '.join(f'{cm:g}' for cm in jittered)} cm"
        found[title] = (
            f"protocol {plan.protocol}{noise}, {plan.samples} samples, seed {plan.seed}; "
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
        for metric, error in (("ade_sample", "ADE"), ("fde_sample", "FDE"))
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
        "does it; at every k-th frame (the facts above count them) everyone in it is judged over "
        "the steps of their future that exist. Agents are grouped by the steps at which they had "
        "been seen since they last (re)appeared."
    )
    return Section("Few observations, protocol streaming", (about,), section.contents)


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
    places = [published.place(one) for one in sets]
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
