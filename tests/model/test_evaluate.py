"""The harness: right figures by hand, an honest guard, a fingerprint, known results."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from trajectron_model.baselines.constant_velocity import ConstantVelocity
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Protocol, Window
from trajectron_model.evaluate import (
    BEST_OF,
    Contender,
    Entry,
    EvaluationSet,
    InSampleError,
    evaluate,
    judge,
)
from trajectron_model.predictor import Predictor, WindowForecast
from trajectron_model.results import BestOf, Displacement, Evaluation

SHORT = Protocol("short", observed=2, horizon=2, min_agents=2)


def standing(name: str = "square", steps: int = 5) -> Recording:
    """Two people who stand still at (0, 0) and (10, 0)."""
    step, agent = np.indices((steps, 2)).reshape(2, -1)
    return Recording.from_rows(
        name=name,
        dt_s=0.4,
        start_time_s=0.0,
        ids=["left", "right"],
        types=["pedestrian"] * 2,
        step=step,
        agent=agent,
        position=np.stack([10.0 * agent, np.zeros(len(agent))], axis=-1),
        source_sha256=f"file of {name}",
    )


class Drifting:
    """Samples that miss by given distances, at the first step by nothing, at the last in full."""

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


def entry(predictor: Predictor, *sets: str, sha256: str = "") -> Entry:
    return Entry(predictor.name, {name: Contender(predictor, sha256) for name in sets})


def square(*names: str) -> EvaluationSet:
    return EvaluationSet("square", tuple(standing(name) for name in names or ("square",)))


# The first sample suits the left, the second the right, the third both a little.
MISSES_M = [[0.0, 9.0], [8.0, 1.0], [3.0, 3.0], [4.0, 4.0], [5.0, 5.0]]


def test_scores_are_those_computed_by_hand() -> None:
    evaluation = evaluate(
        [entry(Drifting(MISSES_M), "square")], [square()], protocol=SHORT, samples=5
    )
    (row,) = evaluation.rows
    assert row.mean == row.sets[0].scores
    # The miss is at the last of two steps: ADE is half of FDE.
    assert row.mean.mode_mean == Displacement(2.25, 4.5)  # sample 0: 0 and 9
    assert row.mean.mean.ade_m == pytest.approx(2.1)
    assert row.mean.mean.fde_m == pytest.approx(4.2)  # of 4 and 4.4
    one, five = row.mean.best_of
    assert one == BestOf(1, Displacement(2.1, 4.2), Displacement(2.1, 4.2))
    assert five == BestOf(5, Displacement(0.25, 0.5), Displacement(1.5, 3.0))


def test_best_of_more_than_was_drawn_is_left_out() -> None:
    evaluation = evaluate(
        [entry(ConstantVelocity(), "square")], [square()], protocol=SHORT, samples=20
    )
    assert [best.n for best in evaluation.rows[0].mean.best_of] == [1, 5, 20]


def test_the_mean_weighs_sets_alike_and_agents_within_them() -> None:
    sets = [EvaluationSet("a", (standing(steps=9),)), EvaluationSet("b", (standing(),))]
    first, second = Drifting([[1.0, 3.0]]), Drifting([[6.0, 6.0]])
    family = Entry("family", {"a": Contender(first), "b": Contender(second)})
    (row,) = evaluate([family], sets, protocol=SHORT, samples=1).rows
    assert [one.scores.mean.fde_m for one in row.sets] == [2.0, 6.0]
    assert row.mean.mean.fde_m == 4.0


def test_small_batches_give_the_same_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    windows = SHORT.windows([standing(steps=12)])
    whole = judge(ConstantVelocity(25), windows, samples=20, seed=3, best_of=(1, 5, 20))
    monkeypatch.setattr("trajectron_model.evaluate._MAX_TRAJECTORIES", 1)
    judged: list[int] = []
    split = judge(
        ConstantVelocity(25),
        windows,
        samples=20,
        seed=3,
        best_of=(1, 5, 20),
        progress=judged.append,
    )
    assert judged == [1] * len(windows)
    assert whole.best_of.shape == (2 * len(windows), 3, 2)
    np.testing.assert_array_equal(whole.best_of, split.best_of)
    np.testing.assert_array_equal(whole.joint_best_of, split.joint_best_of)


PROVENANCE: Mapping[str, object] = {
    "training": {"recordings": [{"name": "street", "part": "training", "sha256": "s"}]},
    "validation": {"recordings": [{"name": "park", "part": "validation", "sha256": "p"}]},
}


@pytest.mark.parametrize("role", ["training", "validation"])
@pytest.mark.parametrize(
    "seen", [{"name": "square", "sha256": ""}, {"name": "other", "sha256": "file of square"}]
)
def test_a_model_is_not_judged_on_what_it_has_seen(role: str, seen: Mapping[str, str]) -> None:
    provenance = {**PROVENANCE, role: {"recordings": [seen]}}
    contender = Contender.of_model(ConstantVelocity(), "abc", provenance)
    judged: list[int] = []
    with pytest.raises(InSampleError, match="was trained or selected on square"):
        evaluate(
            [Entry("model", {"square": contender})],
            [square("square", "yard")],
            protocol=SHORT,
            progress=judged.append,
        )
    assert judged == []


@pytest.mark.parametrize(
    "provenance",
    [{}, {"training": {"recordings": []}}, {**PROVENANCE, "training": {"recordings": ["square"]}}],
)
def test_a_model_that_does_not_say_counts_as_having_seen_all(
    provenance: Mapping[str, object],
) -> None:
    contender = Contender.of_model(ConstantVelocity(), "abc", provenance)
    with pytest.raises(InSampleError, match="does not say what it was trained on"):
        evaluate([Entry("model", {"square": contender})], [square()], protocol=SHORT)


def test_in_sample_on_request_marks_the_row() -> None:
    contender = Contender.of_model(ConstantVelocity(), "abc", PROVENANCE)
    model = Entry("model", {"street": contender, "square": contender})
    sets = [square(), EvaluationSet("street", (standing("street"),))]
    (row,) = evaluate([model], sets, protocol=SHORT, in_sample=True).rows
    assert [one.in_sample for one in row.sets] == [False, True]
    assert row.in_sample
    clean = evaluate([model], sets[:1], protocol=SHORT)
    assert not clean.rows[0].in_sample
    marked = evaluate([model], sets, protocol=SHORT, in_sample=True)
    assert "model (in sample)" in marked.to_markdown()
    assert "(in sample)" not in clean.to_markdown()


def test_the_fingerprint_tells_apart_what_cannot_be_compared() -> None:
    def fingerprint(recording: Recording, protocol: Protocol = SHORT) -> tuple[str, str]:
        entries = [entry(ConstantVelocity(), "square")]
        sets = [EvaluationSet("square", (recording,))]
        (one,) = evaluate(entries, sets, protocol=protocol).fingerprint.sets
        return one.data_sha256, one.windows_sha256

    data, windows = fingerprint(standing())
    assert fingerprint(standing()) == (data, windows)
    moved = standing()
    moved.position[0] += 1e-3
    moved_data, moved_windows = fingerprint(moved)
    assert moved_data != data
    assert moved_windows == windows
    longer_data, longer_windows = fingerprint(standing(), Protocol("short", observed=3, horizon=2))
    assert longer_data == data
    assert longer_windows != windows


def test_the_result_is_plain_json() -> None:
    evaluation = evaluate(
        [entry(ConstantVelocity(), "square", sha256="abc")], [square()], protocol=SHORT, seed=9
    )
    content = json.loads(json.dumps(evaluation.to_json()))
    assert content["fingerprint"]["protocol"]["observed"] == 2
    assert content["fingerprint"]["seed"] == 9
    assert content["fingerprint"]["sets"][0]["windows"] == 2
    assert content["fingerprint"]["sets"][0]["agents"] == 4
    assert content["rows"][0]["sets"][0]["model_sha256"] == "abc"
    assert content["rows"][0]["mean"]["best_of"][2]["n"] == 20


def test_what_cannot_be_evaluated_is_refused() -> None:
    one = entry(ConstantVelocity(), "square")
    with pytest.raises(ValueError, match="samples must be at least 1"):
        evaluate([one], [square()], samples=0)
    with pytest.raises(ValueError, match="same name"):
        evaluate([one, one], [square()])
    with pytest.raises(ValueError, match="square has no window of the protocol sgan"):
        evaluate([one], [square()])
    with pytest.raises(ValueError, match="one length"):
        evaluate([], [])


@pytest.fixture(scope="module")
def known(eth_ucy: EthUcy) -> Evaluation:
    """Constant velocity, plain and with noise, on the five sets."""
    sets = [EvaluationSet(name, tuple(eth_ucy.test(name))) for name in TEST_SETS]
    plain, noisy = ConstantVelocity(), ConstantVelocity(heading_noise_deg=25)
    return evaluate([entry(plain, *TEST_SETS), entry(noisy, *TEST_SETS)], sets)


def test_constant_velocity_has_its_known_errors(known: Evaluation) -> None:
    row = known.rows[0]
    errors = {one.test_set: one.scores.mean for one in row.sets}
    expected = {
        "eth": (1.00, 2.23),
        "hotel": (0.32, 0.62),
        "univ": (0.52, 1.17),
        "zara1": (0.43, 0.96),
        "zara2": (0.33, 0.73),
    }
    for name, (ade_m, fde_m) in expected.items():
        assert errors[name].ade_m == pytest.approx(ade_m, abs=0.0055)
        assert errors[name].fde_m == pytest.approx(fde_m, abs=0.0055)
    assert row.mean.mean.ade_m == pytest.approx(0.520, abs=5e-4)
    assert row.mean.mean.fde_m == pytest.approx(1.141, abs=5e-4)
    assert "one trajectory" in known.to_markdown()


def test_constant_velocity_with_noise_has_its_known_best_of_n(known: Evaluation) -> None:
    best = dict(zip(BEST_OF, known.rows[1].mean.best_of, strict=True))
    assert best[20].per_agent.ade_m == pytest.approx(0.405, abs=0.003)
    assert best[20].per_agent.fde_m == pytest.approx(0.853, abs=0.006)
    assert best[100].per_agent.ade_m == pytest.approx(0.388, abs=0.003)
    assert best[100].per_agent.fde_m == pytest.approx(0.814, abs=0.006)
    assert best[100].joint.ade_m == pytest.approx(0.488, abs=0.005)
    assert best[100].joint.fde_m == pytest.approx(1.014, abs=0.01)
