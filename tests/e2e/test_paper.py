"""The paper's figures and tables, shortened; a run that was stopped goes on where it was."""

from __future__ import annotations

import json
import os
import re
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import modes, paper, paper_sections, published, runtime
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window
from trajectron_model.evaluation import judging
from trajectron_model.evaluation.document import Table, cell
from trajectron_model.simulation import Scenario, simulate

DATA = Path(os.environ.get("TRAJECTRON_DATA", Path(__file__).parents[2] / "../shared/data"))
SECTIONS = (
    "ADE and FDE of all samples",
    "Table 1: best of 20",
    "Likelihood of what came",
    "Table 2: runtime",
    "Point forecasts, protocol sgan",
    "Best of N, protocol sgan",
    "Calibration",
    "Few observations, protocol streaming",
    "Noise",
    "Behaviour modes by latent value",
    "How to read this",
)


def write_crowd(file: Path) -> None:
    """Thirty seconds of a crowd at a crossing, as CSV."""
    frames = simulate(Scenario.CROSSING, num_agents=8, dt_s=0.4, seed=4)
    lines = ["time,id,type,x,y"]
    for frame in islice(frames, 75):
        for agent, (x, y) in zip(frame.ids, frame.positions.tolist(), strict=True):
            lines.append(f"{frame.time_s:.1f},{agent},pedestrian,{x},{y}")
    file.write_text("\n".join(lines) + "\n")


def arguments(tmp_path: Path, *more: str) -> list[str]:
    folders = ("--work", str(tmp_path / "work"), "--out", str(tmp_path / "out"))
    return ["--quick", "--models", "constant-velocity-noise,constant-velocity", *folders, *more]


@pytest.mark.timeout(900)
def test_a_quick_run_reports_everything_and_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crowd = tmp_path / "crowd.csv"
    write_crowd(crowd)
    # Stopped in the middle: the last evaluation finds that the machine has gone.
    judged: list[object] = []

    def stopping(*of: Any, **how: Any) -> Any:
        judged.append(of)
        if len(judged) == 10:
            raise KeyboardInterrupt
        return judging.judge(*of, **how)

    monkeypatch.setattr("trajectron_model.evaluation.run.judge", stopping)
    asked = arguments(tmp_path, "--recording", str(crowd))
    with pytest.raises(KeyboardInterrupt):
        paper.main(asked)
    assert not (tmp_path / "out").exists()
    paper.main([*asked, "--only", "streaming"])  # as a second process would
    assert not (tmp_path / "out").exists()
    assert len(list(tmp_path.glob("work/streaming-*/result.json"))) == 1
    with pytest.raises(SystemExit):
        paper.main([*asked, "--only", "table-2"])
    paper.main(asked)
    # Nothing was judged twice but the one that was lost.
    assert len(judged) == len(list(tmp_path.glob("work/*/shards/*.npz"))) + 1
    first = (tmp_path / "out" / "report.html").read_bytes()
    text = first.decode()
    for title in SECTIONS:
        assert f"<h2>{title}</h2>" in text
    assert "None of its figures may be quoted" in text
    assert not re.search(r"https?://", re.sub(r"xmlns[^ ]*?=[^ ]*", "", text))
    drawn = {file.name for file in (tmp_path / "out" / "figures").iterdir()}
    assert {"boxplots-ade.svg", "kde-nll-by-step.svg", "behaviour-modes.svg"} <= drawn
    estimates = json.loads((tmp_path / "out" / "estimates.json").read_text())
    value, low, high = estimates["table-1"]["rows"]["eth_ucy"]["crowd"]["joint_ade_20"]
    assert low <= value <= high and f"{value:.3f}" in text

    def refused(*of: Any, **how: Any) -> Any:
        raise AssertionError("this was done before")

    # A third run judges and times nothing at all.
    monkeypatch.setattr("trajectron_model.evaluation.run.judge", refused)
    monkeypatch.setattr(runtime, "measure_set", refused)
    paper.main(asked)
    assert (tmp_path / "out" / "report.html").read_bytes() == first
    # Timings of other code do not stand in for this one's.
    monkeypatch.setattr(runtime, "VERSION", -1)
    with pytest.raises(AssertionError, match="done before"):
        paper.main(asked)


@pytest.mark.timeout(900)
@pytest.mark.skipif(not (DATA / "eth_ucy").is_dir(), reason="no ETH/UCY data")
def test_a_quick_run_on_the_benchmark_sets_published_rows_beside_ours(tmp_path: Path) -> None:
    paper.main(arguments(tmp_path, "--sets", "eth", "--data", str(DATA)))
    text = (tmp_path / "out" / "report.md").read_text()
    assert "Trajectron Full, as published" in text
    assert "| *0.37* / *0.72* |" in text
    assert "Missing: Social GAN, Social Attention" in text
    assert "Trajectron, z\\_best" in text and "Trajectron, stratified" in text


def walkers(*paths: tuple[tuple[float, float], tuple[float, float]]) -> Recording:
    """People who walk straight for 20 steps: where they start, and their velocity in m/s."""
    steps, agents = np.meshgrid(np.arange(20), np.arange(len(paths)), indexing="ij")
    start, velocity = (np.array(part) for part in zip(*paths, strict=True))
    position = start[agents] + 0.4 * steps[..., None] * velocity[agents]
    return Recording.from_rows(
        name="walkers",
        dt_s=0.4,
        start_time_s=0.0,
        ids=[str(n) for n in range(len(paths))],
        types=["pedestrian"] * len(paths),
        step=steps.ravel(),
        agent=agents.ravel(),
        position=position.reshape(-1, 2),
    )


def test_the_scene_is_that_of_the_pair_whose_straight_paths_come_closest() -> None:
    side_by_side = (((0.0, 0.0), (1.0, 0.0)), ((0.0, 0.3), (1.0, 0.0)))
    crossing = (((0.0, 10.0), (1.0, 0.0)), ((5.0, 5.2), (0.0, 1.0)))
    standing = ((5.0, 10.0), (0.0, 0.0))
    scene = modes.choose([walkers(*side_by_side, *crossing, standing)])
    assert scene is not None and scene.pair == (2, 3)
    assert modes.choose([walkers(*side_by_side, standing)]) is None


def test_runtimes_are_ratios_to_the_reference_of_the_same_repeat() -> None:
    seconds = iter([1.0, 2.0, 4.0])
    clock = [0.0]

    def taking(times: Any) -> runtime.Prepare:
        def call() -> None:
            clock[0] += next(times)

        return lambda window: call

    def twice() -> Any:
        # Warm-up, then three repeats; the reference takes 1, 2 and 4 seconds.
        yield 9.0
        yield from (0.5, 2.0, 4.0)

    def reference() -> Any:
        yield 9.0
        yield from seconds

    scene = Window(walkers(((0.0, 0.0), (1.0, 0.0))), 0, 8, 12, np.array([0]))
    ready = {runtime.REFERENCE: taking(reference()), "ours": taking(twice())}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("time.perf_counter", lambda: clock[0])
        found = runtime.measure([scene], ready, repeats=3)
    ours = found["ours"]
    assert (ours.median_s, ours.low_s, ours.high_s) == (2.0, 0.5, 4.0)
    assert (ours.ratio, ours.ratio_low, ours.ratio_high) == (1.0, 0.5, 1.0)


def test_scenes_of_the_runtime_have_everyone_in_sight() -> None:
    recording = walkers(*[((float(n), 0.0), (0.0, 1.0)) for n in range(5)])
    (scene,) = runtime.scenes([recording], 12)
    assert scene.now == 7 and len(scene.judged) == 5


def test_published_rows_are_muted_and_only_of_the_sets_that_were_judged() -> None:
    table = Table("t", ("", "Hotel"), ((cell("ours"), cell("0.1")),))

    found = paper_sections.beside(table, published.TABLE_1[:1], ["hotel"])
    assert found.muted == {1}
    assert [figure.text for figure in found.rows[1][1]] == ["0.20", "0.35"]
    assert paper_sections.beside(table, published.TABLE_1, ["crowd"]) is table
