"""The report of an evaluation: ``report.html``, ``report.md`` and the figures beside it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from trajectron_model.evaluation import exhibits, pictures
from trajectron_model.evaluation.document import Cell, Document, Picture, Section, Table, cell
from trajectron_model.evaluation.exhibits import Metric
from trajectron_model.evaluation.figures import Style
from trajectron_model.evaluation.pictures import AllScores
from trajectron_model.evaluation.results import Evaluation

PROTOCOLS = {
    "sgan": "windows of 8 observed steps and 12 to foretell, stride 1, judged on the people "
    "present in all 20 where at least two are (Gupta et al. 2018)",
    "all": "windows of 8 observed steps and 12 to foretell, stride 1, judged on the people "
    "present in all 20, single ones too",
    "streaming": "every frame of each recording, observed from its first; judged is everyone in "
    "the frame over the steps of their future that exist",
    "paper": "chunks of 100 steps, forecasts from every eighth; judged are those present at the "
    "newest observed step and the next, best-of-N over those present for nine "
    "(Ivanovic & Pavone 2019)",
}

ADE, FDE = "ADE", "FDE"
_FEW_AGENTS = 400

Exhibit = Table | Picture


def write_report(evaluation: Evaluation, scores: AllScores | None, folder: Path) -> None:
    """Writes the report of an evaluation into a folder; see `Document.write`.

    Args:
        evaluation: its figures.
        scores: of the agents, by entry and set (`run.load_scores`); None leaves the boxplots
            out.
        folder: where to; made where there is none.
    """
    document(evaluation, scores).write(folder)


def document(evaluation: Evaluation, scores: AllScores | None = None) -> Document:
    """The report as a value; see `write_report`."""
    style = exhibits.entry_styles([evaluation])
    sections = (
        errors(evaluation, scores, style),
        best_of(evaluation, style),
        likelihood(evaluation, style),
        calibration(evaluation, style),
        observations(evaluation, style),
        types(evaluation),
        tests(evaluation),
        what_was_judged(evaluation),
        Section("How to read this", caveats(evaluation)),
    )
    plan = evaluation.fingerprint.plan
    return Document(
        f"Evaluation under the protocol {plan.protocol}",
        (
            (
                f"Forecasts of {evaluation.fingerprint.horizon} steps of "
                f"{evaluation.fingerprint.dt_s:g} s, each entry on the same windows with the same "
                "inputs. Small print gives 95% bootstrap intervals over windows; the best of each "
                "column is marked. Errors are in metres, likelihoods in nats; lower is better "
                "unless said otherwise."
            ),
        ),
        facts(evaluation),
        tuple(section for section in sections if section.contents or section.paragraphs),
    )


def facts(evaluation: Evaluation) -> dict[str, str]:
    """What another evaluation must share to be comparable, in short."""
    fingerprint = evaluation.fingerprint
    plan = fingerprint.plan
    found = {
        "Protocol": f"{plan.protocol}: {PROTOCOLS[plan.protocol]}",
        "Sets": ", ".join(
            f"{exhibits.set_title(one.test_set)} ({one.windows} windows, {one.agents} agents)"
            for one in fingerprint.sets
        ),
        "Windows": fingerprint.selection,
        "Samples": f"{plan.samples} of each agent, independent unless a row says stratified, "
        f"seed {plan.seed}; "
        f"{fingerprint.kde_samples} in kernel density estimates",
        "Intervals": f"{plan.bootstrap} resamplings of windows",
    }
    if plan.jitter_m:
        found["Jitter"] = f"{100 * plan.jitter_m:g} cm on every observed coordinate; truth without"
    return found


def errors(evaluation: Evaluation, scores: AllScores | None, style: Mapping[str, Style]) -> Section:
    """Point forecasts, the distribution of all samples' errors, and errors by step."""
    found: list[Exhibit | None] = [
        exhibits.by_set(
            evaluation,
            _pair("ade_mean", "fde_mean"),
            "Mean over all modes: ADE / FDE in metres",
        ),
        exhibits.by_set(
            evaluation,
            _pair("ade_mode", "fde_mode"),
            "Mean of the most probable mode: ADE / FDE in metres",
        ),
    ]
    if scores is not None:
        found += [boxplot(evaluation, scores, error, style) for error in (ADE, FDE)]
    found.append(
        pictures.curves_by_step(
            evaluation,
            "distance_mean",
            style,
            name="errors-by-step",
            label="distance, m",
            caption="Distance between the mean over all modes and the truth by seconds ahead, "
            "with 95% bands.",
        )
    )
    return Section(
        "Point forecasts",
        (
            (
                "One trajectory for each agent, in both forms: the mean over all modes, and the "
                "mean of the most probable mode. Predictors without modes have one form only."
            ),
        ),
        _there(found),
    )


def boxplot(
    evaluation: Evaluation, scores: AllScores, error: str, style: Mapping[str, Style]
) -> Picture | None:
    """The paper's boxplots of an error, `ADE` or `FDE`; see `pictures.boxplots`."""
    return pictures.boxplots(
        evaluation,
        scores,
        error.lower(),
        style,
        name=f"boxplots-{error.lower()}",
        label=f"{error}, m",
        caption=f"{error} of every sample of every judged agent, each set on its own axis: boxes "
        "span the quartiles, whiskers 5% to 95%, crosses are means. Entries with a single "
        "trajectory are dashed lines at their mean.",
    )


def best_of(evaluation: Evaluation, style: Mapping[str, Style]) -> Section:
    """Best-of-N per agent and joint, by set and by N, and the metrics of samples."""
    found: list[Exhibit | None] = []
    for n in (20, 100):
        found += [
            exhibits.by_set(
                evaluation,
                _pair(f"{form}_ade_{n}", f"{form}_fde_{n}"),
                f"Best of {n}, {_FORMS[form]}: ADE / FDE in metres",
            )
            for form in _FORMS
        ]
    found.append(
        exhibits.by_metric(
            evaluation,
            [
                Metric(f"{form}_ade_{n}", f"{n}, {short}")
                for form, short in (("min", "per agent"), ("joint", "joint"))
                for n in (1, 5, 20, 100)
            ],
            "ADE of the best of N, mean over sets, metres",
        )
    )
    found.append(
        exhibits.by_metric(
            evaluation,
            [
                Metric("miss_1", "miss rate, one sample, %", 1, 100.0),
                Metric("miss_20", "miss rate, best of 20, %", 1, 100.0),
                Metric("brier_fde", "brier-minFDE of 5 modes"),
                Metric("energy", "energy score, m"),
                Metric("collision", "colliding pairs, %", 2, 100.0),
            ],
            "Metrics of samples and modes, mean over sets",
            "A miss ends more than 2 m off. The energy score is of whole trajectories. Pairs "
            "collide when their sampled paths come within 0.1 m.",
        )
    )
    found.append(
        pictures.curves_by_step(
            evaluation,
            "min_distance_20",
            style,
            name="best-of-20-by-step",
            label="distance, m",
            caption="Distance of the best of 20 samples, chosen at every step for itself, by "
            "seconds ahead, with 95% bands.",
        )
    )
    return Section(
        "Best of N samples",
        (
            (
                "Per agent, each agent picks its own best sample; joint, one sample index serves "
                "all agents of the scene. These are different tasks: compare like with like. "
                "Samples are independent and nothing is selected or clustered; a row of stratified "
                "samples, where there is one, stands beside and is not ranked."
            ),
        ),
        _there(found),
    )


_FORMS = {"min": "per agent", "joint": "joint over the scene"}


def likelihood(evaluation: Evaluation, style: Mapping[str, Style]) -> Section:
    """Negative log likelihoods, by set and by step."""
    found: list[Exhibit | None] = [
        exhibits.by_set(evaluation, [Metric(name, name, 2)], caption)
        for name, caption in (
            ("nll_kde", "KDE negative log likelihood per step, nats"),
            ("nll_mixture", "Negative log likelihood of the analytic mixture per step, nats"),
            ("nll_exact", "Exact negative log likelihood of the whole trajectory, nats"),
        )
    ]
    found += kde(evaluation, style)
    found.append(
        pictures.curves_by_step(
            evaluation,
            "nll_mixture",
            style,
            name="mixture-nll-by-step",
            label="NLL, nats",
            caption="Negative log likelihood of the analytic position mixture by seconds ahead, "
            "with 95% bands.",
            zero=False,
        )
    )
    return Section(
        "Likelihood of what came",
        (
            (
                "Densities are over position in metres. The kernel estimate (scipy's gaussian_kde "
                "with its defaults, floored at −20 in the log) is of each step by itself, so it is "
                "a smoothed marginal, not the trajectory's likelihood. A predictor with a single "
                "trajectory has no density: it stands at the floor, 20, and in no figure."
            ),
        ),
        _there(found),
    )


def kde(evaluation: Evaluation, style: Mapping[str, Style]) -> list[Picture | None]:
    """KDE negative log likelihood by set and by step, as the paper draws it."""
    shown = f"{evaluation.fingerprint.kde_samples} samples"
    return [
        pictures.points_by_set(
            evaluation,
            "nll_kde",
            style,
            name="kde-nll-by-set",
            label="KDE NLL, nats",
            caption=f"KDE negative log likelihood by set, {shown}, with 95% intervals.",
            spread=True,
        ),
        pictures.curves_by_step(
            evaluation,
            "nll_kde",
            style,
            name="kde-nll-by-step",
            label="KDE NLL, nats",
            caption=f"KDE negative log likelihood by seconds ahead, {shown}, with 95% bands.",
            zero=False,
            spread=True,
        ),
    ]


def calibration(evaluation: Evaluation, style: Mapping[str, Style]) -> Section:
    """Coverage of highest-density regions, and their size."""
    levels = exhibits.LEVELS
    coverage = [
        Metric(exhibits.coverage_metric(level), f"{100 * level:g}%", 1, 100.0, level)
        for level in levels
    ]
    area = [
        Metric(f"area_{100 * level:g}", f"{100 * level:g}%", 2, ranked=False) for level in levels
    ]
    found: list[Exhibit | None] = [
        exhibits.by_metric(
            evaluation, coverage, "Observed coverage of nominal regions, mean over sets, %"
        ),
        exhibits.by_set(
            evaluation, coverage[1:2], "Observed coverage of the 80% regions by set, %"
        ),
        exhibits.by_metric(evaluation, area, "Mean area of the regions, mean over sets, m²"),
        pictures.calibration(
            evaluation,
            name="calibration",
            caption="Observed over nominal coverage of highest-density regions, with 95% bands; "
            "below the diagonal a forecast is too sure.",
        ),
        pictures.coverage_by_step(
            evaluation,
            style,
            name="coverage-by-step",
            caption="Observed coverage by seconds ahead, mean over sets, with 95% bands; the "
            "dashed line is nominal.",
        ),
    ]
    of_samples = [
        exhibits.title_of(row.name)
        for row in evaluation.rows
        if any(one.regions_of == "kde" for one in row.sets)
    ]
    about = "Shares of truths inside the smallest regions that hold so much of the forecast."
    if of_samples:
        about += (
            " Regions are of the analytic position mixture; of a kernel estimate of 100 samples "
            f"for {', '.join(of_samples)}."
        )
    return Section("Calibration", (about,), _there(found))


def observations(evaluation: Evaluation, style: Mapping[str, Style]) -> Section:
    """Errors by how many steps an agent was seen, where that differs."""
    found: list[Exhibit | None] = [
        exhibits.by_group(
            evaluation,
            "observations",
            _pair("ade_mean", "fde_mean"),
            "Mean over all modes, by steps seen: ADE / FDE in metres, mean over sets",
        ),
        exhibits.by_group(
            evaluation,
            "observations",
            _pair("min_ade_20", "min_fde_20"),
            "Best of 20 per agent, by steps seen: ADE / FDE in metres, mean over sets",
        ),
        pictures.curves_by_observations(
            evaluation,
            "ade_mean",
            style,
            name="errors-by-observations",
            label="ADE, m",
            caption="ADE of the mean over all modes by the number of steps seen since the agent "
            "(re)appeared, with 95% bands.",
        ),
    ]
    shown = _there(found)
    about = (
        "Agents by the number of steps at which they had been seen since they last (re)appeared.",
    )
    return Section("Few observations", about if shown else (), shown)


def types(evaluation: Evaluation) -> Section:
    """Errors by agent type, where there are several."""
    found = exhibits.by_group(
        evaluation,
        "type",
        _pair("ade_mean", "fde_mean"),
        "Mean over all modes, by agent type: ADE / FDE in metres, mean over sets",
    )
    return Section("Agent types", (), _there([found]))


def tests(evaluation: Evaluation) -> Section:
    """Paired t-tests of all entries against the first model among them."""
    reference = reference_of(evaluation)
    if reference is None:
        return Section("t-tests")
    compared = {
        "ade_mean": ("ADE of the mean over all modes, m", 3),
        "fde_mean": ("FDE of the mean over all modes, m", 3),
        "min_ade_20": ("ADE of the best of 20 per agent, m", 3),
        "joint_ade_100": ("ADE of the best of 100, joint, m", 3),
        "nll_kde": ("KDE negative log likelihood, nats", 2),
    }
    shown = _there(
        exhibits.t_tests(evaluation, metric, title, reference=reference, places=places)
        for metric, (title, places) in compared.items()
    )
    about = (
        (
            "Two-tailed t-tests on the means of the same windows, as in the paper. All pairs of "
            "entries are in the JSON result."
        ),
    )
    return Section("t-tests", about if shown else (), shown)


def reference_of(evaluation: Evaluation) -> str | None:
    """The entry that the others are set against: the first with a model file; else the first."""
    rows = [row for row in evaluation.rows if exhibits.ranked(row)]
    if len(evaluation.rows) < 2 or not rows:
        return None
    with_file = [row for row in rows if row.sets[0].model_sha256]
    return (with_file or rows)[0].name


def what_was_judged(evaluation: Evaluation) -> Section:
    """The protocol's fingerprint: data, windows and models, by their hashes."""
    sets = evaluation.fingerprint.sets
    data = Table(
        "Sets",
        ("", "recordings", "windows", "agents", "in best-of-N", "data", "windows' hash"),
        tuple(
            (
                cell(exhibits.set_title(one.test_set)),
                cell(", ".join(one.recordings)),
                cell(str(one.windows)),
                cell(str(one.agents)),
                cell(str(one.agents_in_best_of)),
                cell(one.data_sha256[:12]),
                cell(one.windows_sha256[:12]),
            )
            for one in sets
        ),
        "Hashes are the first 12 digits of SHA-256; the JSON result has them whole.",
    )
    models = Table(
        "Models",
        ("", *(exhibits.set_title(one.test_set) for one in sets)),
        tuple(
            (
                cell(exhibits.row_title(row)),
                *(_model(one.model, one.model_sha256) for one in row.sets),
            )
            for row in evaluation.rows
        ),
    )
    return Section("What was judged", (), (data, models))


def _model(name: str, sha256: str) -> Cell:
    return cell(f"{name} ({sha256[:12]})" if sha256 else name)


def caveats(evaluation: Evaluation) -> tuple[str, ...]:
    """What a reader should know before quoting a figure of this evaluation."""
    fingerprint = evaluation.fingerprint
    found = [
        (
            "Intervals and t-tests resample and pair windows. Windows overlap in time, so "
            "neighbouring ones are not independent: both are narrower than they would be on "
            "independent scenes, for all entries alike."
        ),
        "In the mean over sets each set weighs the same; under “all agents” each agent does.",
        (
            "Per agent and joint best-of-N are different tasks, and best-of-N rewards spread as "
            "well as accuracy: read it beside the likelihoods and the calibration."
        ),
    ]
    few = [one for one in fingerprint.sets if one.agents < _FEW_AGENTS]
    if few and len(fingerprint.sets) > 1:
        named = ", ".join(f"{exhibits.set_title(one.test_set)} ({one.agents})" for one in few)
        found.append(
            f"Few agents were judged on {named}; each still has "
            f"{100 / len(fingerprint.sets):.0f}% of the mean over sets."
        )
    if fingerprint.selection != "all":
        found.append(
            f"Not all windows were judged ({fingerprint.selection}): the figures are not those of "
            "the whole sets."
        )
    if any(row.in_sample for row in evaluation.rows):
        found.append(
            "Rows marked “in sample” were trained or selected on recordings that they are judged "
            "on: they say nothing of new scenes, and are not ranked."
        )
    if any(exhibits.fenced(row) for row in evaluation.rows):
        found.append(
            "paper-leaky has the future in its inputs, as the published figures have. It is there "
            "to show what that is worth; it cannot be served, and is not ranked."
        )
    return tuple(found)


def _pair(ade: str, fde: str) -> list[Metric]:
    return [Metric(ade, ADE), Metric(fde, FDE)]


def _there(found: Sequence[Exhibit | None] | Iterator[Exhibit | None]) -> tuple[Exhibit, ...]:
    return tuple(one for one in found if one is not None)
