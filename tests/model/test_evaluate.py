"""The harness: figures by hand, an honest guard, a fingerprint, runs that stop and go on."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from trajectron_model.baselines.constant_velocity import ConstantVelocity
from trajectron_model.config import ModelConfig
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window
from trajectron_model.evaluation import contenders, run, sets
from trajectron_model.evaluation.contenders import Contender, InSampleError
from trajectron_model.evaluation.plan import EvaluationPlan, PlanError
from trajectron_model.evaluation.results import Estimate, Evaluation
from trajectron_model.evaluation.run import Cancelled, Progress
from trajectron_model.predictor import Predictor, TrajectronPredictor, WindowForecast
from trajectron_model.trajectron import Trajectron

STEPS = 23  # four windows of the protocol sgan


class Drifting:
    """Samples that miss by given distances, at the last step in full, before by nothing."""

    name = "drifting"

    def __init__(self, misses_m: Sequence[Sequence[float]]) -> None:
        self._misses_m = np.array(misses_m)  # [S, A]

    def predict(
        self, windows: Sequence[Window], *, num_samples: int, seed: int
    ) -> list[WindowForecast]:
        samples = []
        for window in windows:
            offset = np.zeros((num_samples, *window.future().shape))
            offset[:, :, -1, 1] = self._misses_m[:num_samples]
            samples.append(window.future() + offset)
        return [WindowForecast(one, one[0], one.mean(axis=0)) for one in samples]


# The first sample suits the left, the second the right, the third both a little.
MISSES_M = [[0.0, 9.0], [8.0, 1.0], [3.0, 3.0], [4.0, 4.0], [5.0, 5.0]]


def write_square(file: Path, steps: int = STEPS, shift: float = 0.0) -> str:
    """Two people who stand still at (1, 1) and (11, 1), as ETH/UCY text."""
    rows = [
        f"{10 * step}\t{agent + 1}\t{1.0 + 10.0 * agent + shift}\t1.0\n"
        for step in range(steps)
        for agent in range(2)
    ]
    file.write_text("".join(rows))
    return str(file)


@pytest.fixture
def square(tmp_path: Path) -> str:
    return write_square(tmp_path / "square.txt")


Stand = Callable[..., None]


@pytest.fixture
def stand(monkeypatch: pytest.MonkeyPatch) -> Stand:
    """Gives names of entries to predictors of a test's own."""

    def names(**predictors: Predictor | Contender | Mapping[str, Predictor]) -> None:
        def resolve(name: str, test_set: str, _: Sequence[Recording]) -> Contender:
            found = predictors[name]
            if isinstance(found, Mapping):
                found = found[test_set]
            return found if isinstance(found, Contender) else Contender(found)

        monkeypatch.setattr(contenders, "resolve", resolve)

    return names


def plan(*files: str, **fields: object) -> EvaluationPlan:
    given: dict[str, object] = {"entries": ("model",), "files": files, "samples": 5}
    return EvaluationPlan(**(given | {"bootstrap": 100} | fields))  # type: ignore[arg-type]


def values(evaluation: Evaluation, row: int = 0) -> dict[str, float]:
    return {name: one.value for name, one in evaluation.rows[row].mean.metrics.items()}


def test_scores_are_those_computed_by_hand(stand: Stand, square: str, tmp_path: Path) -> None:
    stand(model=Drifting(MISSES_M))
    found = values(run.run(plan(square), tmp_path / "work"))
    # The miss is at the last of twelve steps: ADE is a twelfth of FDE.
    assert found["fde_mode"] == pytest.approx(4.5)  # sample 0: 0 and 9
    assert found["ade_mode"] == pytest.approx(4.5 / 12)
    assert found["fde_mean"] == pytest.approx(4.2)  # of 4 and 4.4
    assert found["fde_sample"] == pytest.approx(4.2)
    assert found["min_fde_1"] == found["joint_fde_1"] == pytest.approx(4.2)
    assert found["min_fde_5"] == pytest.approx(0.5)  # 0 and 1
    assert found["joint_fde_5"] == pytest.approx(3.0)  # 3 and 3
    assert found["joint_ade_5"] == pytest.approx(3.0 / 12)
    assert found["miss_1"] == pytest.approx(0.8)  # all but 0 and 1 of ten
    assert found["miss_5"] == 0.0
    assert found["collision"] == 0.0
    assert "nll_mixture" not in found
    assert "min_fde_20" not in found  # five samples were drawn


def test_of_dependent_samples_there_is_a_best_of_all_alone(
    stand: Stand, square: str, tmp_path: Path
) -> None:
    """Some of a stratified draw are not a stratified draw: nothing is said of their best."""
    stand(model=Contender(Drifting(MISSES_M), independent=False))
    found = values(run.run(plan(square), tmp_path / "work"))
    assert found["min_fde_5"] == pytest.approx(0.5)
    assert not {"min_fde_1", "joint_fde_1", "miss_1", "energy"} & found.keys()
    fewer = values(run.run(plan(square, samples=1, kde_samples=5), tmp_path / "fewer"))
    assert not [name for name in fewer if name.startswith(("min_", "joint_", "miss_"))]
    assert fewer["fde_sample"] == pytest.approx(4.5)  # of the one that counts


def test_best_of_n_is_over_the_agents_that_count(stand: Stand, tmp_path: Path) -> None:
    """Under ``paper``: the second walker is not seen from t - 8 on, at the first t."""
    file = tmp_path / "chunk.txt"
    rows = [
        f"{10 * step}\t{agent}\t{agent}.0\t1.0\n"
        for step in range(29)
        for agent in (1, 2)
        if agent == 1 or step >= 7
    ]
    file.write_text("".join(rows))
    stand(model=Drifting(MISSES_M))
    evaluation = run.run(plan(str(file), protocol="paper", kde_samples=5), tmp_path / "work")
    (of_set,) = evaluation.fingerprint.sets
    assert (of_set.windows, of_set.agents, of_set.agents_in_best_of) == (2, 4, 3)
    found = evaluation.rows[0].mean.metrics
    assert (found["fde_sample"].agents, found["min_fde_5"].agents) == (4, 3)
    assert found["fde_sample"].value == pytest.approx(4.2)
    # Best of five: 0 for the first twice, 1 for the second once; jointly 0, and 3 and 3.
    assert found["min_fde_5"].value == pytest.approx((0.0 + 0.0 + 1.0) / 3, abs=1e-6)
    assert found["joint_fde_5"].value == pytest.approx((0.0 + 3.0 + 3.0) / 3)
    assert "2 / 4 (best of N: 3)" in evaluation.to_markdown()


def test_a_window_without_agents_for_best_of_n_has_other_scores(
    stand: Stand, tmp_path: Path
) -> None:
    """One window, at t = 8, and one walker, seen from t - 1 on; another left at once."""
    file = tmp_path / "chunk.txt"
    rows = [f"{10 * step}\t1\t1.0\t1.0\n" for step in range(7, 28)]
    file.write_text("".join(["0\t2\t5.0\t5.0\n", *rows]))
    stand(model=Drifting([[2.0], [4.0]]))
    asked = plan(str(file), protocol="paper", samples=2, kde_samples=2)
    evaluation = run.run(asked, tmp_path / "work")
    metrics = evaluation.rows[0].mean.metrics
    assert metrics["fde_sample"] == Estimate(3.0, 3.0, 3.0, 1)
    assert "min_fde_1" not in metrics
    assert "1 / 1 (best of N: 0)" in evaluation.to_markdown()


def test_horizon_steps_have_figures_of_their_own(stand: Stand, square: str, tmp_path: Path) -> None:
    stand(model=Drifting(MISSES_M))
    (row,) = run.run(plan(square), tmp_path / "work").rows
    steps = [one.value for one in row.mean.by_step["distance_mean"] if one is not None]
    assert steps == [0.0] * 11 + [pytest.approx(4.2)]
    assert row.sets[0].scores.by_step.keys() == row.mean.by_step.keys()


def test_a_step_unknown_in_one_set_moves_no_figure_of_another(stand: Stand, tmp_path: Path) -> None:
    """Both stand for the 8 observed steps, then walk 1 m a step; one is unseen at the third."""

    def write(name: str, unseen: Sequence[int]) -> str:
        file = tmp_path / name
        rows = [f"{10 * t}\t1\t{1 + max(0, t - 7)}.0\t1.0\n" for t in range(21) if t not in unseen]
        file.write_text("".join(rows))
        return str(file)

    files = write("whole.txt", ()), write("gap.txt", (7 + 3,))
    stand(model=ConstantVelocity())
    evaluation = run.run(plan(*files, protocol="paper", samples=2), tmp_path / "work")
    lines = [line.split(",") for line in evaluation.to_csv().splitlines()]
    for over in ("mean", "pooled"):
        found = {line[4]: line[5] for line in lines if line[1:4] == [over, "", "distance_mode"]}
        del found[""]  # the figure over all steps
        assert found == {f"{step}": f"{step}.0" for step in range(1, 13) if step != 3}


def test_sets_weigh_alike_in_the_mean_and_agents_in_the_pool(stand: Stand, tmp_path: Path) -> None:
    files = write_square(tmp_path / "a.txt", 27), write_square(tmp_path / "b.txt", 23)
    stand(model={"a": Drifting([[1.0, 3.0]]), "b": Drifting([[6.0, 6.0]])})
    (row,) = run.run(plan(*files, samples=1), tmp_path / "work").rows
    assert [one.scores.metrics["fde_mean"].value for one in row.sets] == [2.0, 6.0]
    assert row.mean.metrics["fde_mean"].value == 4.0
    # Eight windows and four.
    assert row.pooled.metrics["fde_mean"].value == pytest.approx((2.0 * 8 + 6.0 * 4) / 12, 1e-5)
    assert row.pooled.metrics["fde_mean"].agents == 24


def test_intervals_are_of_windows(stand: Stand, square: str, tmp_path: Path) -> None:
    """Agents differ, windows do not: resampling windows changes nothing."""
    stand(model=Drifting(MISSES_M))
    (row,) = run.run(plan(square), tmp_path / "work").rows
    found = row.mean.metrics["fde_mode"]
    assert found == Estimate(4.5, 4.5, 4.5, 8)


def test_paired_tests_compare_entries_over_the_same_windows(
    stand: Stand, square: str, tmp_path: Path
) -> None:
    noisy = ConstantVelocity(heading_noise_deg=25.0)
    stand(one=Drifting([[1.0, 3.0]]), other=Drifting([[2.0, 4.5]]), noisy=noisy)
    entries = ("one", "other", "noisy")
    found = run.run(plan(square, entries=entries, samples=1), tmp_path / "work").comparisons
    # Of the same difference in every window there is no spread to test against.
    assert not [c for c in found if (c.first, c.second) == ("one", "other")]
    assert {c.metric for c in found} <= {"ade_mean", "fde_mean", "ade_sample", "fde_sample"}


# In sample or not.

PROVENANCE: Mapping[str, object] = {
    "training": {"recordings": [{"name": "street", "part": "training", "sha256": "s"}]},
    "validation": {"recordings": [{"name": "park", "part": "validation", "sha256": "p"}]},
}


@pytest.mark.parametrize("role", ["training", "validation"])
@pytest.mark.parametrize("by", ["name", "content"])
def test_a_model_is_not_judged_on_what_it_has_seen(
    role: str, by: str, stand: Stand, square: str, tmp_path: Path
) -> None:
    from trajectron_model.data.readers import read

    sha256 = read(square).source_sha256
    seen = {"name": "square", "sha256": ""} if by == "name" else {"name": "x", "sha256": sha256}
    provenance = {**PROVENANCE, role: {"recordings": [seen]}}
    stand(model=Contender.of_model(ConstantVelocity(), "abc", provenance))
    told: list[Progress] = []
    with pytest.raises(InSampleError, match="was trained or selected on square"):
        run.run(plan(square), tmp_path / "work", progress=told.append)
    assert told == []


@pytest.mark.parametrize(
    "provenance",
    [{}, {"training": {"recordings": []}}, {**PROVENANCE, "training": {"recordings": ["square"]}}],
)
def test_a_model_that_does_not_say_counts_as_having_seen_all(
    provenance: Mapping[str, object], stand: Stand, square: str, tmp_path: Path
) -> None:
    stand(model=Contender.of_model(ConstantVelocity(), "abc", provenance))
    with pytest.raises(InSampleError, match="does not say what it was trained on"):
        run.run(plan(square), tmp_path / "work")


def test_in_sample_on_request_marks_the_row(stand: Stand, square: str, tmp_path: Path) -> None:
    street = write_square(tmp_path / "street.txt", shift=1.0)
    stand(model=Contender.of_model(ConstantVelocity(), "abc", PROVENANCE))
    marked = run.run(plan(square, street, in_sample=True), tmp_path / "marked")
    assert [one.in_sample for one in marked.rows[0].sets] == [False, True]
    assert marked.rows[0].in_sample
    assert "model (in sample)" in marked.to_markdown()
    clean = run.run(plan(square), tmp_path / "clean")
    assert not clean.rows[0].in_sample
    assert "(in sample)" not in clean.to_markdown()


# Names.


def test_samples_of_the_stratified_variant_alone_are_dependent() -> None:
    entries = ("leave-one-out", "leave-one-out@z_best", "leave-one-out@stratified", "kalman")
    found = [contenders.resolve(entry, "zara1").independent for entry in entries]
    assert found == [True, True, False, True]


def test_names_stand_for_baselines_and_bundled_models() -> None:
    assert contenders.resolve("constant-velocity", "eth").predictor.name == "constant velocity"
    family = contenders.resolve("leave-one-out", "hotel")
    assert family.predictor.name == "eth_ucy-without-hotel"
    assert family.sha256
    assert family.seen
    best = contenders.resolve("leave-one-out@z_best", "hotel")
    assert best.predictor.name == "eth_ucy-without-hotel@z_best"
    assert (best.sha256, best.seen) == (family.sha256, family.seen)


def test_a_learned_baseline_is_the_one_trained_without_the_set(eth_ucy: EthUcy) -> None:
    kalman = contenders.resolve("kalman", "eth")
    assert kalman.sha256
    assert kalman.seen_of(eth_ucy.test("eth")) == ()
    assert kalman.seen_of(eth_ucy.test("hotel")) == ("biwi_hotel",)


@pytest.mark.parametrize(
    ("name", "test_set", "reason"),
    [
        ("leave-one-out", "street", "not for street; name a model"),
        ("leave-one-out@best", "eth", "the variants are z_best and stratified"),
        ("linear@z_best", "eth", "baselines have no variants"),
        ("paper-leaky", "street", "not on street"),
        ("paper-leaky@z_best", "eth", "its variants are @seed-0"),
        ("nowhere", "eth", "nowhere: neither a bundled model"),
    ],
)
def test_names_that_stand_for_nothing_are_refused(name: str, test_set: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        contenders.resolve(name, test_set)


# The fingerprint.


def test_the_fingerprint_tells_apart_what_cannot_be_compared(stand: Stand, tmp_path: Path) -> None:
    stand(model=ConstantVelocity())
    numbers = iter(range(99))

    def fingerprint(shift: float = 0.0, **fields: object) -> tuple[str, str]:
        folder = tmp_path / f"{next(numbers)}"
        folder.mkdir()
        file = write_square(folder / "square.txt", shift=shift)
        (one,) = run.run(plan(file, samples=1, **fields), folder / "work").fingerprint.sets
        return one.data_sha256, one.windows_sha256

    data, windows = fingerprint()
    assert fingerprint() == (data, windows)
    assert fingerprint(jitter_m=0.1) == (data, windows)  # that is the plan's to say
    assert fingerprint(shift=1e-3) != (data, windows)
    assert fingerprint(shift=1e-3)[1] == windows
    assert fingerprint(protocol="all") == (data, windows)  # here they cut the same windows
    streamed, other = fingerprint(protocol="streaming")
    assert (streamed == data, other == windows) == (True, False)
    assert fingerprint(max_windows=2) != (data, windows)


def test_the_selection_of_windows_is_named(stand: Stand, square: str, tmp_path: Path) -> None:
    stand(model=ConstantVelocity())
    found = run.run(plan(square, max_windows=2), tmp_path / "work").fingerprint
    assert found.selection == "every 2nd"
    assert (found.sets[0].windows, found.sets[0].agents) == (2, 4)


# Running, stopping, going on.


class Counting(ConstantVelocity):
    """Counts what it is asked."""

    def __init__(self) -> None:
        super().__init__(heading_noise_deg=25.0)
        self.asked: list[int] = []

    def predict(
        self, windows: Sequence[Window], *, num_samples: int, seed: int
    ) -> list[WindowForecast]:
        self.asked.append(len(windows))
        return super().predict(windows, num_samples=num_samples, seed=seed)


@pytest.fixture
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    """One window a shard."""
    monkeypatch.setattr(run, "_TRAJECTORIES", 1)


@pytest.fixture
def walkers(tmp_path: Path) -> str:
    """Three who walk, so that noise on headings shows."""
    random = np.random.default_rng(0)
    walks = np.cumsum(random.normal([0.5, 0.0], 0.05, (STEPS, 3, 2)), axis=0) + 1.0
    file = tmp_path / "walkers.txt"
    rows = [
        f"{10 * step}\t{agent + 1}\t{x:.4f}\t{y:.4f}\n"
        for step, scene in enumerate(walks.tolist())
        for agent, (x, y) in enumerate(scene)
    ]
    file.write_text("".join(rows))
    return str(file)


def test_a_run_goes_on_where_it_was_stopped(
    stand: Stand, walkers: str, tmp_path: Path, small_shards: None
) -> None:
    asked = plan(walkers, samples=20)
    whole = Counting()
    stand(model=whole)
    expected = run.run(asked, tmp_path / "whole")
    assert whole.asked == [1, 1, 1, 1]
    stopped = Counting()
    stand(model=stopped)
    done: list[Progress] = []
    with pytest.raises(Cancelled):
        run.run(
            asked,
            tmp_path / "work",
            progress=done.append,
            cancelled=lambda: done[-1].windows_done == 3,
        )
    assert stopped.asked == [1, 1, 1]
    assert not (tmp_path / "work" / "result.json").exists()
    with pytest.raises(ValueError, match="no evaluation was completed there"):
        run.load(tmp_path / "work")
    resumed = Counting()
    stand(model=resumed)
    assert run.run(asked, tmp_path / "work") == expected
    assert resumed.asked == [1]
    # Once more: nothing is left to do.
    assert run.run(asked, tmp_path / "work") == expected
    assert resumed.asked == [1]


def test_figures_do_not_depend_on_how_the_work_is_cut(
    stand: Stand, walkers: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand(model=ConstantVelocity(heading_noise_deg=25.0))
    asked = plan(walkers, samples=20)
    whole = run.run(asked, tmp_path / "whole")
    monkeypatch.setattr(run, "_TRAJECTORIES", 1)
    assert run.run(asked, tmp_path / "cut") == whole
    assert len(list((tmp_path / "whole" / "shards").iterdir())) == 1
    assert len(list((tmp_path / "cut" / "shards").iterdir())) == 4


def test_the_model_too_scores_the_same_however_its_work_is_cut(
    stand: Stand, walkers: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(7)
    small = ModelConfig(decoder_size=16, latent_values=4, mixture_components=3)
    model = Trajectron(small).eval()
    asked = plan(walkers, samples=20, protocol="streaming")

    def scores(folder: str) -> Mapping[str, np.ndarray]:
        stand(model=TrajectronPredictor(model, "small"))
        run.run(asked, tmp_path / folder)
        return run.load_scores(asked, tmp_path / folder)["model", "walkers"].columns

    whole = scores("whole")
    monkeypatch.setattr(run, "_TRAJECTORIES", 300)
    cut = scores("cut")
    assert len(list((tmp_path / "cut" / "shards").iterdir())) > 3
    assert {"nll_exact", "nll_mixture", "nll_kde", "brier_fde"} < whole.keys()
    for name, column in whole.items():
        if name.startswith("coverage"):  # of few draws: one may fall on the other side
            assert np.nanmean(abs(cut[name] - column)) < 0.01
            np.testing.assert_array_equal(np.isnan(cut[name]), np.isnan(column))
        else:
            np.testing.assert_allclose(cut[name], column, rtol=2e-3, atol=2e-3, err_msg=name)


def test_a_forecast_that_is_not_finite_is_refused(
    stand: Stand, square: str, tmp_path: Path
) -> None:
    stand(model=Drifting([[np.nan, 0.0]]))
    with pytest.raises(ValueError, match="drifting forecast positions that are not finite"):
        run.run(plan(square, samples=1), tmp_path / "work")


def test_the_seed_chooses_samples_and_nothing_else(
    stand: Stand, walkers: str, tmp_path: Path
) -> None:
    stand(model=ConstantVelocity(heading_noise_deg=25.0))
    first, second = (
        values(run.run(plan(walkers, samples=20, seed=seed), tmp_path / f"{seed}"))
        for seed in (1, 2)
    )
    assert first["fde_mean"] == second["fde_mean"]
    assert first["min_fde_20"] != second["min_fde_20"]


def test_a_folder_is_one_plans_own(stand: Stand, square: str, tmp_path: Path) -> None:
    stand(model=ConstantVelocity())
    run.run(plan(square), tmp_path / "work")
    with pytest.raises(PlanError, match="holds the work of another plan"):
        run.run(plan(square, seed=1), tmp_path / "work")


def test_another_models_shards_are_not_taken_up(stand: Stand, square: str, tmp_path: Path) -> None:
    stand(model=Contender(ConstantVelocity(), "old weights"))
    run.run(plan(square), tmp_path / "work")
    changed = Counting()
    stand(model=Contender(changed, "new weights"))
    run.run(plan(square), tmp_path / "work")
    assert changed.asked == [4]


def test_a_torn_shard_is_never_taken_for_a_whole_one(
    stand: Stand, square: str, tmp_path: Path
) -> None:
    """A process that dies while it writes leaves a partial file, under another name."""
    stand(model=Counting())
    expected = run.run(plan(square), tmp_path / "whole")
    (shard,) = (tmp_path / "whole" / "shards").iterdir()
    torn = tmp_path / "work" / "shards" / (shard.name + ".partial")
    torn.parent.mkdir(parents=True)
    torn.write_bytes(shard.read_bytes()[:100])
    assert run.run(plan(square), tmp_path / "work") == expected


def test_progress_counts_windows_of_all_entries(
    stand: Stand, square: str, tmp_path: Path, small_shards: None
) -> None:
    stand(first=ConstantVelocity(), second=ConstantVelocity())
    told: list[Progress] = []
    entries = ("first", "second")
    run.run(plan(square, entries=entries), tmp_path / "work", progress=told.append)
    assert [one.windows_done for one in told] == [0, 1, 2, 3, 4, 5, 6, 7, 8]
    assert {one.windows_total for one in told} == {8}
    assert (told[0].share, told[0].seconds_left) == (0.0, None)
    assert (told[4].entry, told[4].share) == ("first", 0.5)
    left = [one.seconds_left for one in told[1:]]
    assert all(one is not None and one >= 0.0 for one in left)
    assert (told[-1].share, left[-1]) == (1.0, 0.0)


# What comes out.


def test_the_result_goes_to_json_and_back(stand: Stand, walkers: str, tmp_path: Path) -> None:
    stand(a=ConstantVelocity(), b=ConstantVelocity(heading_noise_deg=25.0))
    asked = plan(walkers, entries=("a", "b"), samples=20, protocol="streaming", seed=9)
    evaluation = run.run(asked, tmp_path / "work")
    content = json.loads(json.dumps(evaluation.to_json(), allow_nan=False))
    assert Evaluation.from_json(content) == evaluation
    assert run.load(tmp_path / "work") == evaluation
    assert content["fingerprint"]["plan"]["seed"] == 9
    assert evaluation.comparisons
    for wrong in ({}, {**content, "rows": [{}]}, {**content, "fingerprint": None}):
        with pytest.raises(ValueError, match="not the JSON of an evaluation"):
            Evaluation.from_json(wrong)


def test_streaming_is_broken_down_by_observations(
    stand: Stand, walkers: str, tmp_path: Path
) -> None:
    stand(model=ConstantVelocity())
    (row,) = run.run(plan(walkers, protocol="streaming"), tmp_path / "work").rows
    groups = {one.group: one.scores for one in row.sets[0].groups if one.by == "observations"}
    # Three walkers, seen for 23 steps; at the last nobody has a future.
    counts = {name: scores.metrics["ade_mean"].agents for name, scores in groups.items()}
    assert counts == {
        "1": 3, "2": 3, "3": 3, "at least 1": 66, "at least 2": 63, "at least 4": 57,
        "at least 8": 45,
    }  # fmt: skip
    # Who was seen once is taken to stand still.
    assert groups["1"].metrics["fde_mean"].value > 4.0 > groups["2"].metrics["fde_mean"].value
    assert [one.group for one in row.groups] == [one.group for one in row.sets[0].groups]


def test_csv_has_a_line_for_each_estimate(stand: Stand, square: str, tmp_path: Path) -> None:
    stand(model=Drifting(MISSES_M))
    lines = run.run(plan(square), tmp_path / "work").to_csv().splitlines()
    assert lines[0] == "entry,set,group,metric,step,value,low,high,agents"
    assert "model,square,,min_fde_5,,0.5,0.5,0.5,8" in lines
    assert "model,mean,,distance_mode,12,4.5,4.5,4.5,8" in lines


def test_agents_scores_can_be_had_after_a_run(
    stand: Stand, square: str, tmp_path: Path, small_shards: None
) -> None:
    stand(model=Drifting(MISSES_M))
    run.run(plan(square), tmp_path / "work")
    scores = run.load_scores(plan(square), tmp_path / "work")["model", "square"]
    assert scores.columns["fde_mode"].tolist() == [0.0, 9.0] * 4
    assert scores.window.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert scores.agent.tolist() == ["1", "2"] * 4
    assert scores.observations.tolist() == [8] * 8
    next((tmp_path / "work" / "shards").iterdir()).unlink()
    with pytest.raises(ValueError, match="1 of 4 shards are missing"):
        run.load_scores(plan(square), tmp_path / "work")


# Plans.


def test_a_plan_goes_to_json_and_back() -> None:
    asked = EvaluationPlan(entries=("a", "b"), sets=("eth",), protocol="paper", max_windows=7)
    assert EvaluationPlan.from_json(json.loads(json.dumps(asked.to_json()))) == asked
    assert (asked.samples_in_kde, asked.samples_drawn) == (2000, 2000)
    assert dataclasses.replace(asked, protocol="sgan").samples_in_kde == 100


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"entries": []}, "entries must be one or more distinct names"),
        ({"entries": ["a", "a"]}, "entries must be one or more distinct names"),
        ({"entries": "abc"}, "entries must be a list of texts"),
        ({"sets": []}, "give either sets or files"),
        ({"files": ["a.txt"]}, "give either sets or files"),
        ({"sets": [], "files": ["a/x.txt", "b/x.txt"]}, "distinct names; they are x, x"),
        ({"protocol": "own"}, "protocol 'own' is none of sgan, all, streaming, paper"),
        ({"samples": 0}, "samples must be a whole number from 1 to 2000; it is 0"),
        ({"samples": 2.5}, "samples must be a whole number"),
        ({"samples": True}, "samples must be a whole number"),
        ({"seed": -1}, "seed must be"),
        ({"kde_samples": 1}, "kde_samples must be"),
        ({"jitter_m": float("nan")}, "jitter_m must be a number"),
        ({"in_sample": "no"}, "in_sample must be a bool"),
        ({"sample": 5}, "unknown fields: sample"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(fields: Mapping[str, object], reason: str) -> None:
    with pytest.raises(PlanError, match=reason):
        EvaluationPlan.from_json({"entries": ["a"], "sets": ["eth"], **fields})


def test_what_cannot_be_evaluated_is_refused(stand: Stand, tmp_path: Path) -> None:
    stand(model=ConstantVelocity())
    short = write_square(tmp_path / "short.txt", 19)
    with pytest.raises(PlanError, match="short has no window of the protocol sgan"):
        run.run(plan(short), tmp_path / "work")


def test_an_unknown_set_is_refused(stand: Stand, eth_ucy: EthUcy, tmp_path: Path) -> None:
    stand(model=ConstantVelocity())
    with pytest.raises(PlanError, match="unknown: moon; the test sets are eth, hotel"):
        run.run(plan(sets=("eth", "moon")), tmp_path / "work", data=eth_ucy.folder)


# Known results, on the real recordings.


def test_shards_of_a_crowd_are_bounded(eth_ucy: EthUcy, tmp_path: Path) -> None:
    """Univ with 2000 samples: a shard draws what fits in some hundred megabytes."""
    asked = EvaluationPlan(("constant-velocity",), sets=("univ",), samples=2000)
    (crowd,) = sets.load(asked, eth_ucy.folder)
    largest = max(len(window.judged) for window in crowd.windows)
    shards = run._shards(asked, tmp_path, [crowd])
    assert sum(shard.agents for shard in shards) == crowd.agents == 24334
    assert max(shard.agents for shard in shards) * 2000 <= max(largest * 2000, 100_000)
    assert largest * 2000 * 12 * 2 * 8 < 60e6  # bytes of one window's samples as doubles


def test_constant_velocity_has_its_known_errors(eth_ucy: EthUcy, tmp_path: Path) -> None:
    asked = EvaluationPlan(("constant-velocity",), sets=TEST_SETS, samples=1, bootstrap=100)
    evaluation = run.run(asked, tmp_path, data=eth_ucy.folder)
    (row,) = evaluation.rows
    expected = {
        "eth": (1.00, 2.23),
        "hotel": (0.32, 0.62),
        "univ": (0.52, 1.17),
        "zara1": (0.43, 0.96),
        "zara2": (0.33, 0.73),
    }
    for one in row.sets:
        ade_m, fde_m = expected[one.test_set]
        assert one.scores.metrics["ade_mean"].value == pytest.approx(ade_m, abs=0.0055)
        assert one.scores.metrics["fde_mean"].value == pytest.approx(fde_m, abs=0.0055)
    assert row.mean.metrics["ade_mean"].value == pytest.approx(0.520, abs=5e-4)
    assert row.mean.metrics["fde_mean"].value == pytest.approx(1.141, abs=5e-4)
    assert "one trajectory" in evaluation.to_markdown()


def test_constant_velocity_with_noise_has_its_known_best_of_n(
    eth_ucy: EthUcy, tmp_path: Path
) -> None:
    entries = ("constant-velocity-noise",)
    asked = EvaluationPlan(entries, sets=("eth", "hotel", "zara1"), samples=20, bootstrap=100)
    (row,) = run.run(asked, tmp_path, data=eth_ucy.folder).rows
    expected = {"eth": (0.86, 1.90), "hotel": (0.24, 0.46), "zara1": (0.31, 0.62)}
    for one in row.sets:
        ade_m, fde_m = expected[one.test_set]
        assert one.scores.metrics["min_ade_20"].value == pytest.approx(ade_m, abs=0.015)
        assert one.scores.metrics["min_fde_20"].value == pytest.approx(fde_m, abs=0.03)
