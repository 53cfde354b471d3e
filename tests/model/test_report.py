"""The report of an evaluation: its figures, marked honestly; one page that needs nothing else."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest

from trajectron_model.evaluation import document, exhibits, figures, metrics, report
from trajectron_model.evaluation.document import Document, Figure, Picture, Section, Table, cell
from trajectron_model.evaluation.exhibits import Metric
from trajectron_model.evaluation.plan import EvaluationPlan
from trajectron_model.evaluation.results import (
    Comparison,
    Estimate,
    Evaluation,
    Fingerprint,
    GroupScores,
    Row,
    Scores,
    SetFingerprint,
    SetScores,
)
from trajectron_model.evaluation.scores import AgentScores

HORIZON = 3
SETS = ("eth", "hotel")
HOSTILE = '<script>alert("1")</script> & $x_1$ |*_`\x00'


def scores(value: float, *, spread: bool = True) -> Scores:
    """Every metric at one value, with an interval of a tenth around it."""

    def estimate(at: float) -> Estimate:
        return Estimate(at, at - 0.1, at + 0.1, 10)

    names = ["ade_mean", "fde_mean", "ade_mode", "fde_mode", "nll_kde", "area_95", "energy"]
    names += [f"{form}_{e}_20" for form in ("min", "joint") for e in ("ade", "fde")]
    found = {name: estimate(value) for name in names}
    if not spread:
        found["area_95"] = Estimate(0.0, 0.0, 0.0, 10)
    found |= {exhibits.coverage_metric(level): estimate(level) for level in exhibits.LEVELS}
    steps = ("distance_mean", "nll_kde", "coverage_50", "coverage_80", "coverage_90", "coverage_95")
    by_step = {name: tuple(estimate(value + step) for step in range(HORIZON)) for name in steps}
    return Scores(found, by_step | {"distance_mean": (estimate(value), None, estimate(value))})


def row(name: str, values: tuple[float, float], *, in_sample: bool = False) -> Row:
    groups = tuple(
        GroupScores("observations", group, scores(values[0] + place))
        for place, group in enumerate(("1", "2", "at least 1"))
    )
    sets = tuple(
        SetScores(test_set, name, "ab" * 32, in_sample, "mixture", scores(value), groups)
        for test_set, value in zip(SETS, values, strict=True)
    )
    mean = scores(sum(values) / 2)
    return Row(name, in_sample, sets, mean, mean, groups)


def evaluation(*rows: Row) -> Evaluation:
    plan = EvaluationPlan(tuple(one.name for one in rows), sets=SETS, samples=20)
    fingerprints = tuple(
        SetFingerprint(name, (f"{name}.txt",), "cd" * 32, "ef" * 32, 70, 181, 181) for name in SETS
    )
    comparisons = tuple(
        Comparison(rows[0].name, other.name, "ade_mean", name, 70, -0.25, -3.0, 0.004)
        for other in rows[1:]
        for name in (*SETS, "")
    )
    return Evaluation(Fingerprint(plan, 0.4, HORIZON, "all", 20, fingerprints), rows, comparisons)


def sampled(values: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> AgentScores:
    """Agents with these sample errors and nothing else."""
    agents = len(values)
    none = np.zeros(agents, dtype=np.int64)
    text = np.full(agents, "pedestrian")
    return AgentScores(none, text, text, none, {}, {"ade": values, "fde": 2.0 * values})


TWO = evaluation(row("leave-one-out", (0.5, 0.3)), row("sgan", (0.4, 0.9)))


class Page(HTMLParser):
    """Every tag, every address, and the text that a reader sees."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in {"src", "href"}]

    def handle_data(self, data: str) -> None:
        self.text += data


def pictures_of(page: Page) -> list[str]:
    prefix = "data:image/svg+xml,"
    found = [one.removeprefix(prefix) for one in page.addresses if one.startswith(prefix)]
    return [unquote(one) for one in found]


def test_the_page_shows_the_figures_and_their_intervals() -> None:
    page = Page(report.document(TWO).to_html())
    for text in ("0.500", "0.400 to 0.600", "0.300", "Social GAN", "Trajectron", "181 agents"):
        assert text in page.text
    assert "ETH" in page.text and "Hotel" in page.text
    drawn = pictures_of(page)
    assert len(drawn) >= 5
    assert all("Trajectron" in one for one in drawn)


def test_the_page_needs_nothing_but_itself() -> None:
    text = report.document(TWO).to_html()
    page = Page(text)
    assert all(one.startswith(("data:", "#")) for one in page.addresses)
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    outside = re.compile(r"url\(\s*['\"]?(?!#)|@import|https?://")
    assert not outside.search(re.sub(r'src="data:[^"]*"', "", text))
    for drawing in pictures_of(page):
        ET.fromstring(drawing)  # well-formed
        without_names = re.sub(r'xmlns(:\w+)?="[^"]*"', "", drawing)
        assert not outside.search(without_names)


def test_names_from_uploads_are_text_and_never_markup() -> None:
    hostile = evaluation(row("leave-one-out", (0.5, 0.3)), row(HOSTILE, (0.4, 0.9)))
    sets = tuple(
        replace(one, test_set=HOSTILE) if place else one
        for place, one in enumerate(hostile.fingerprint.sets)
    )
    hostile = replace(hostile, fingerprint=replace(hostile.fingerprint, sets=sets))
    made = report.document(hostile)
    text = made.to_html()
    page = Page(text)
    assert "script" not in page.tags and "<script" not in text
    assert '<script>alert("1")</script> & $x_1$ |*_`\N{REPLACEMENT CHARACTER}' in page.text
    for drawing in pictures_of(page):
        ET.fromstring(drawing)
        assert "<script" not in drawing
    markdown = made.to_markdown()
    assert "<script" not in markdown and "\x00" not in markdown
    rows = [line for line in markdown.splitlines() if line.startswith("| ")]
    assert all(line.endswith(" |") for line in rows)


def test_the_best_of_each_column_is_marked_and_ties_are_all_best() -> None:
    three = evaluation(
        row("leave-one-out", (0.5, 0.3)), row("sgan", (0.4, 0.9)), row("lstm", (0.4001, 0.8))
    )
    table = exhibits.by_set(three, [Metric("ade_mean", "ADE")], "ADE")
    assert table is not None
    assert table.header == ("", "ETH", "Hotel", "mean", "all agents")
    marks = [[figure.best for (figure,) in line[1:3]] for line in table.rows]
    assert marks == [[False, True], [True, False], [True, False]]


def test_a_calibrated_forecast_is_nearest_to_its_nominal_level() -> None:
    def covering(name: str, share: float) -> Row:
        mean = replace(scores(0.5), metrics={"coverage_80": Estimate(share, share, share, 9)})
        return replace(row(name, (0.5, 0.5)), mean=mean)

    found = exhibits.by_metric(
        evaluation(covering("leave-one-out", 0.78), covering("sgan", 0.95)),
        [Metric("coverage_80", "80%", 1, 100.0, 0.8)],
        "coverage",
    )
    assert found is not None
    assert found.rows[0][1] == (Figure("78.0", "78.0 to 78.0", best=True),)
    assert not found.rows[1][1][0].best


@pytest.mark.parametrize("name", ["eth_ucy", "paper-leaky", "paper-leaky@seed-1"])
def test_rows_in_sample_or_fenced_are_shown_and_never_ranked(name: str) -> None:
    unranked = row(name, (0.1, 0.1), in_sample=name == "eth_ucy")
    three = evaluation(row("leave-one-out", (0.5, 0.3)), row("sgan", (0.4, 0.9)), unranked)
    table = exhibits.by_set(three, [Metric("ade_mean", "ADE")], "ADE")
    assert table is not None and table.muted == {2}
    assert not any(figure.best for cells in table.rows[2] for figure in cells)
    assert table.rows[1][1][0].best
    text = " ".join(report.caveats(three))
    assert ("in sample" in text) == (name == "eth_ucy")
    assert ("paper-leaky" in text) == name.startswith("paper-leaky")


def test_t_tests_are_set_against_the_reference_whichever_way_they_were_made() -> None:
    forward = exhibits.t_tests(TWO, "ade_mean", "ADE", reference="leave-one-out")
    backward = exhibits.t_tests(TWO, "ade_mean", "ADE", reference="sgan")
    assert forward is not None and backward is not None
    assert forward.rows[0][1] == (Figure("\N{MINUS SIGN}0.250", "p = 0.004", best=True),)
    assert backward.rows[0][1][0] == Figure("+0.250", "p = 0.004")
    assert backward.rows[0][0] == cell("Trajectron")


def test_boxplots_box_those_with_samples_and_draw_the_others_as_lines() -> None:
    random = np.random.default_rng(0)
    found = {}
    for test_set in SETS:
        found["leave-one-out", test_set] = sampled(random.gamma(2.0, 0.3, (30, 20)))
        found["sgan", test_set] = sampled(np.full((30, 20), 0.7))
    page = Page(report.document(TWO, found).to_html())
    assert "ADE of every sample" in page.text
    without = Page(report.document(TWO).to_html())
    assert len(pictures_of(page)) == len(pictures_of(without)) + 2


def test_sorted_slices_keep_the_mean_and_the_order() -> None:
    errors = np.array([[4.0, 1.0], [2.0, 1.0], [3.0, 1.0], [1.0, 1.0]])  # [S, A]
    np.testing.assert_array_equal(metrics.sorted_slices(errors, 2), [[1.5, 3.5], [1.0, 1.0]])
    assert metrics.sorted_slices(errors, 9).shape == (2, 4)


def test_what_an_evaluation_lacks_leaves_no_empty_section() -> None:
    one = evaluation(replace(row("leave-one-out", (0.5, 0.3)), groups=()))
    titles = [section.title for section in report.document(one).sections]
    assert "Few observations" not in titles and "t-tests" not in titles
    assert titles[-1] == "How to read this"


def test_a_report_replaces_the_one_before_it(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "old.svg").write_text("<svg/>")
    report.write_report(TWO, None, tmp_path)
    assert {file.name for file in tmp_path.iterdir()} == {"report.html", "report.md", "figures"}
    drawn = {file.name for file in (tmp_path / "figures").iterdir()}
    assert "old.svg" not in drawn
    named = set(re.findall(r'src="figures/([^"]+)"', (tmp_path / "report.md").read_text()))
    assert named == drawn
    before = (tmp_path / "report.html").read_bytes()
    report.write_report(TWO, None, tmp_path)
    assert (tmp_path / "report.html").read_bytes() == before


def test_two_figures_of_one_name_are_refused(tmp_path: Path) -> None:
    picture = Picture("same", "caption", b"<svg/>")
    twice = Document("t", (), {}, (Section("s", (), (picture, picture)),))
    with pytest.raises(ValueError, match="same name"):
        twice.write(tmp_path)
    with pytest.raises(ValueError, match="no name for a figure"):
        Picture("../up", "caption", b"")
    with pytest.raises(ValueError, match="1 cells in a row, 2 in the header"):
        Table("caption", ("", "a"), ((cell("x"),),))


def test_a_curve_is_cut_at_what_is_unknown_and_bands_stay_in_view() -> None:
    curve = figures.Curve([1.0, 2.0, 3.0], [1.0, np.nan, 9.0], [1.0, np.nan, 8.0], [1, np.nan, 12])
    drawn = figures.curves(
        {"ETH": {"a": curve}}, figures.styles(["a"]), label="error, m", below="seconds"
    )
    low, high = drawn.axes[0].get_ylim()
    assert low == 0.0 and high >= 12.0


def test_long_names_are_cut_and_variants_named() -> None:
    assert len(exhibits.title_of("x" * 300)) == len(exhibits.set_title("y" * 300)) == 48
    assert exhibits.title_of("leave-one-out@z_best") == "Trajectron, z_best"
    assert exhibits.title_of("runs/mine@2") == "runs/mine@2"


def test_control_characters_never_reach_a_page() -> None:
    assert document.clean("a\x1b[31mb\ud800\tc") == "a\ufffd[31mb\ufffd\tc"
