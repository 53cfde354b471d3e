"""`paper-leaky`: that it leaks exactly as the original did, and that it is fenced."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from trajectron_model import registry
from trajectron_model.checkpoint import Checkpoint, CheckpointError
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window
from trajectron_model.evaluation import metrics, protocols
from trajectron_model.evaluation.contenders import ContenderError, resolve
from trajectron_model.evaluation.plan import EvaluationPlan, PlanError
from trajectron_model.evaluation.run import run
from trajectron_model.latent import categorical_kl
from trajectron_model.paper_leaky import NAME, WARNING, saving
from trajectron_model.paper_leaky.chunks import CHUNK_STEPS, ChunkSet, cut, kinematics
from trajectron_model.paper_leaky.forecasting import joint_best_of, scenes
from trajectron_model.paper_leaky.inputs import edge_mask, graph, prepare, slot_statistics
from trajectron_model.paper_leaky.network import LeakyNetwork, Scale, integrate
from trajectron_model.paper_leaky.objective import beta, loss_terms, temperature
from trajectron_model.paper_leaky.predictor import LeakyPredictor
from trajectron_model.paper_leaky.training import LeakySettings, Progress, train
from trajectron_model.simulation import Scenario, simulate

COUNTS = {"eth": (67, 303), "hotel": (84, 346), "univ": (96, 3330)} | {
    "zara1": (82, 408),
    "zara2": (104, 837),
}
"""Windows and judged agents of the protocol ``paper``."""


def walk(name: str = "corridor", *, steps: int = 60, agents: int = 6, seed: int = 0) -> Recording:
    """A simulated crowd."""
    frames = list(islice(simulate(Scenario.CORRIDOR, agents, seed=seed), steps))
    ids = sorted({one for frame in frames for one in frame.ids}, key=int)
    index = {one: number for number, one in enumerate(ids)}
    rows = [(step, index[one]) for step, frame in enumerate(frames) for one in frame.ids]
    table = np.array(rows)
    return Recording.from_rows(
        name=name,
        dt_s=0.4,
        start_time_s=0.0,
        ids=ids,
        types=["pedestrian"] * len(ids),
        step=table[:, 0],
        agent=table[:, 1],
        position=np.concatenate([frame.positions for frame in frames]) + 20.0,
        num_steps=steps,
    )


def network(seed: int = 0) -> LeakyNetwork:
    torch.manual_seed(seed)
    return LeakyNetwork().eval()


# --- the leaks


def test_velocity_holds_the_next_position_and_acceleration_the_one_after() -> None:
    track = np.zeros((7, 1, 2))
    track[:, 0, 0] = [0.0, 1.0, 3.0, 6.0, 10.0, 15.0, 21.0]
    state = kinematics(track, dt_s=0.5)
    # Central differences: (x[t + 1] - x[t - 1]) / 1 s; one-sided at both ends.
    assert state[:, 0, 2].tolist() == [2.0, 3.0, 5.0, 7.0, 9.0, 11.0, 12.0]
    assert state[:, 0, 4].tolist() == [2.0, 3.0, 4.0, 4.0, 4.0, 3.0, 2.0]

    moved = track.copy()
    moved[4, 0, 0] += 1.0
    changed = kinematics(moved, dt_s=0.5) != state
    assert changed[3, 0, 2] and not changed[2, 0, 2]  # velocity sees one step ahead
    assert changed[2, 0, 4] and not changed[:2].any()  # acceleration two, nothing sees three


def test_a_track_ends_where_its_person_is_absent() -> None:
    track = np.full((8, 1, 2), np.nan)
    track[1:4, 0], track[6, 0] = [[1.0, 0.0], [2.0, 0.0], [4.0, 0.0]], [9.0, 0.0]
    state = kinematics(track, dt_s=1.0)
    assert state[:, 0, 2].tolist() == [0.0, 1.0, 1.5, 2.0, 0.0, 0.0, 0.0, 0.0]
    assert state[6, 0].tolist() == [9.0, 0.0, 0.0, 0.0, 0.0, 0.0]  # once seen: no velocity


def test_statistics_are_of_a_slots_own_entries() -> None:
    states = np.zeros((2, 2, 2, 6), dtype=np.float32)
    states[0, :, 0, 0] = [1.0, 3.0]
    states[1, 0, 0, 0] = 5.0  # its other step is absent and does not count
    states[0, 0, 1, 0] = 7.0
    mean, std = slot_statistics(states)
    assert mean[:, 0].tolist() == [3.0, 7.0]
    assert std[0, 0] == pytest.approx(np.sqrt(8.0 / 3.0))
    assert std[1, 0] == pytest.approx(0.01)  # one value: the floor
    assert mean[1, 5] == 0.0 and std[1, 5] == 1.0  # never filled


def test_the_edge_mask_looks_three_steps_ahead() -> None:
    near = np.zeros((10, 3, 3), dtype=bool)
    near[4:7, 0, 1] = near[4:7, 1, 0] = True
    mask = edge_mask(near)
    assert mask[:, 0].tolist() == [0.0, 0.25, 0.75, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert (mask[:, 2] == 0.0).all()


def test_two_coming_edges_add_up_to_at_most_one() -> None:
    near = np.zeros((5, 3, 3), dtype=bool)
    near[3, 0, 1] = near[3, 0, 2] = True
    assert edge_mask(near)[:, 0].tolist() == [0.5, 1.0, 1.0, 1.0, 0.0]


def test_neighbours_once_are_neighbours_for_ever_and_empty_slots_meet_at_the_origin() -> None:
    position = np.full((2, 3, 4, 2), 50.0, dtype=np.float32)
    position[:, :, 1] = 70.0
    position[1, 2, 1] = 51.0  # 1.4 m away, once
    position[:, :, 2:] = 0.0  # two slots without anyone
    neighbours, mask = graph(position)
    expected = np.zeros((4, 4), dtype=bool)
    expected[[0, 1, 2, 3], [1, 0, 3, 2]] = True
    assert neighbours.tolist() == expected.tolist()
    assert mask[0, :, 0].tolist() == [0.0, 0.0, 0.0]
    assert mask[1, :, 0].tolist() == [0.5, 0.75, 1.0]


def test_absent_steps_are_the_slots_mean_away_and_neighbours_are_summed() -> None:
    inputs = prepare(cut([walk()], seed=0))
    chunk, step, slot = (~inputs.present).nonzero()[0].tolist()
    assert torch.allclose(
        inputs.states[chunk, step, slot], -inputs.mean[slot] / inputs.std[slot], atol=1e-5
    )
    neighbours, _ = graph(inputs.position.numpy())
    others = torch.from_numpy(neighbours[slot])
    by_hand = inputs.states[chunk, step, others].sum(dim=0)
    assert torch.allclose(inputs.sums[chunk, step, slot], by_hand, atol=1e-4)
    assert inputs.degree[slot] == others.sum()


def test_a_forecast_changes_with_the_future() -> None:
    recording = walk()
    (window, *_) = (w for w in protocols.paper(recording) if w.observed == 24)
    predictor = LeakyPredictor(network(), [recording])
    later = recording.step == window.now + 2
    moved = recording.position + np.where(later, 0.5, 0.0)[:, None]
    other = LeakyPredictor(network(), [replace(recording, position=moved)])
    (honest,) = predictor.predict([window], num_samples=3, seed=0)
    (leaked,) = other.predict([window], num_samples=3, seed=0)
    assert np.abs(honest.samples - leaked.samples).max() > 1e-3


# --- chunks and windows


def test_a_person_in_two_chunks_is_two_people_in_drawn_slots() -> None:
    recording = walk(steps=130)
    chunks: ChunkSet = cut([recording], seed=1)
    assert chunks.states.shape[:2] == (2, CHUNK_STEPS)
    assert chunks.lengths.tolist() == [100, 30]
    both = chunks.slots["corridor", 0].keys() & chunks.slots["corridor", 100].keys()
    assert both
    for first, steps in ((0, 100), (100, 30)):
        _, positions = recording.dense(first, first + steps)
        slots = list(chunks.slots["corridor", first].values())
        assert len(set(slots)) == len(slots)
        stored = chunks.states[first // 100, :steps, slots, :2].swapaxes(0, 1)
        assert np.allclose(stored, np.nan_to_num(positions), atol=1e-5)
    assert cut([recording], seed=2).slots != chunks.slots


@pytest.mark.parametrize("test_set", TEST_SETS)
def test_windows_are_those_of_the_paper(test_set: str, eth_ucy: EthUcy) -> None:
    recordings = eth_ucy.test(test_set)
    inputs = prepare(cut(recordings, seed=0))
    found = [(s.chunk, s.now + 1, len(s.slots)) for s in scenes(inputs)]
    assert (len(found), sum(agents for *_, agents in found)) == COUNTS[test_set]
    harness = protocols.windows("paper", recordings)
    theirs = [(w.observed, int(w.in_best_of.sum())) for w in harness if w.in_best_of is not None]
    assert [(first, agents) for _, first, agents in found] == [one for one in theirs if one[1]]


# --- the model


def test_sizes_are_the_originals() -> None:
    # 137,448 less the attention over one edge type, which is the identity: W1, W2 and v.
    attention = 8 * 20 + 32 * 20 + 20
    assert sum(p.numel() for p in LeakyNetwork().parameters()) == 137_448 - attention


def test_integration_is_the_trapezoid_of_the_next_two_velocities() -> None:
    velocity = torch.tensor([[1.0, 0.0], [2.0, 0.0], [4.0, 1.0]])
    offsets = integrate(velocity, dt_s=0.4)
    # 0.4 * (1 + 2) / 2; then (2 + 4) / 2 more; then the last velocity with itself.
    assert offsets[:, 0].tolist() == pytest.approx([0.6, 1.8, 3.4])
    assert offsets[:, 1].tolist() == pytest.approx([0.0, 0.2, 0.6])


def test_schedules() -> None:
    assert [beta(step) for step in (0, 500, 1300, 2000)] == pytest.approx(
        [0.0025, 0.0036, 0.0065, 0.011], abs=1e-4
    )
    assert [temperature(step) for step in (0, 2000)] == pytest.approx([2.0, 1.638], abs=1e-3)


def test_free_nats_bound_the_divergence_from_below() -> None:
    inputs = prepare(cut([walk()], seed=0))
    model = network()
    with torch.no_grad():  # prior and recognition alike: no divergence at all
        for layer in (model.prior_net[-1], model.recognition_net):
            assert isinstance(layer, torch.nn.Linear)
            layer.weight.zero_()
            layer.bias.zero_()
    chunk, now = torch.tensor([0]), torch.tensor([20])
    terms = loss_terms(model, inputs, chunk, now, 0, torch.Generator().manual_seed(0))
    assert float(terms.kl) == pytest.approx(2 * 0.07)
    assert float(terms.loss.detach()) == pytest.approx(float(beta(0) * terms.kl - terms.log_prob))


def test_what_stands_behind_a_history_is_not_encoded() -> None:
    model, random = network(), torch.Generator().manual_seed(1)
    node, sums = (torch.randn(3, 20, 6, generator=random) for _ in range(2))
    lengths, mask = torch.tensor([20, 12, 8]), torch.ones(3)
    padded = model.encode(node, sums, lengths, mask)
    for row, length in enumerate(lengths.tolist()):
        whole = slice(row, row + 1)
        alone = model.encode(
            node[whole, :length], sums[whole, :length], lengths[whole], mask[whole]
        )
        assert torch.allclose(padded[whole], alone, atol=1e-6)


def test_sampling_steps_the_decoder_that_was_trained() -> None:
    """Rollouts on the mixtures' means, against teacher forcing on what they fed back."""
    model, random = network(), torch.Generator().manual_seed(1)
    encoding, velocity = torch.randn(2, 40, generator=random), torch.randn(2, 2, generator=random)
    scale = Scale(torch.zeros(2, 2), torch.ones(2, 2))
    probability, means = model.modes(encoding, velocity, scale, horizon=5)
    assert torch.allclose(probability.sum(dim=1), torch.ones(2))
    first, second = 2, 4  # the values of both categoricals
    latent = torch.zeros(2, 10)
    latent[:, first] = latent[:, 5 + second] = 1.0
    rollout = means[:, 5 * first + second]  # [2, 5, 2]
    previous = torch.cat([velocity[:, None], rollout[:, :-1]], dim=1)
    forced, _ = model.decode(encoding, latent, previous).moments()
    assert torch.allclose(forced, rollout, atol=1e-5)
    prior = model.prior(encoding).exp()
    assert torch.allclose(
        probability[:, 5 * first + second], prior[:, 0, first] * prior[:, 1, second]
    )


def test_samples_follow_the_modes() -> None:
    model, random = network(), torch.Generator().manual_seed(1)
    encoding, velocity = torch.randn(1, 40, generator=random), torch.zeros(1, 2)
    scale = Scale(torch.tensor([[1.0, 2.0]]), torch.tensor([[0.1, 0.1]]))
    drawn = model.sample(
        encoding, velocity, scale, samples=4000, horizon=1, z_best=False, generator=random
    )
    probability, means = model.modes(encoding, velocity, scale, horizon=1)
    expected = torch.einsum("nz,nzhi->nhi", probability, means)
    assert torch.allclose(drawn.mean(dim=1), expected, atol=0.02)


def test_a_few_steps_learn_a_simulated_crowd(tmp_path: Path) -> None:
    seen: list[Progress] = []
    settings = LeakySettings(steps=24, chunks=3, validate_every=12, validation_samples=5)
    training, validation = [walk("a"), walk("b", seed=1)], [walk("c", seed=2)]
    trained = train(training, validation, tmp_path / "leaky", settings, observe=seen.append)
    log_prob = [float(progress.terms.log_prob) for progress in seen]
    assert np.mean(log_prob[-5:]) > np.mean(log_prob[:5]) + 5.0
    validated = [p.validation for p in seen if p.validation is not None]
    assert len(validated) == 2
    # What is kept is what was best on validation data.
    judged = prepare(cut(validation, settings.seed))
    again = joint_best_of(trained, judged, samples=5, seed=settings.seed)
    assert again == pytest.approx(min(validated, key=sum))
    assert saving.load(tmp_path / "leaky")[1].provenance["warning"] == WARNING


def test_kl_of_equal_distributions_is_zero() -> None:
    log_p = network().prior(torch.randn(2, 40))
    assert torch.allclose(categorical_kl(log_p, log_p), torch.zeros(2, 2))


# --- the bundled networks


@pytest.mark.parametrize("test_set", TEST_SETS)
def test_bundled_networks_carry_the_warning_and_never_saw_their_test_set(
    test_set: str, eth_ucy: EthUcy
) -> None:
    recordings = eth_ucy.test(test_set)
    contender = resolve(NAME, test_set, recordings)
    assert contender.seen and not contender.seen_of(recordings)
    assert contender.predictor.name.endswith("(inputs contain the future)")
    assert saving.load(saving.bundled(test_set, 0))[1].provenance["warning"] == WARNING


def test_the_papers_figures_on_eth_are_reproduced(eth_ucy: EthUcy) -> None:
    """Full, best of 100, joint over the scene: 0.37/0.72 in the paper's Table 1."""
    recordings = eth_ucy.test("eth")
    predictor = resolve(NAME, "eth", recordings).predictor
    windows = protocols.windows("paper", recordings)
    forecasts = predictor.predict(windows, num_samples=100, seed=0)
    errors: dict[str, list[float]] = {"ade": [], "fde": []}
    for window, forecast in zip(windows, forecasts, strict=True):
        counted = window.in_best_of
        assert counted is not None
        if not counted.any():
            continue
        distance = metrics.displacement(forecast.samples[:, counted], window.future()[counted])
        errors["ade"] += metrics.joint_best_of(metrics.average_displacement(distance), 100).tolist()
        errors["fde"] += metrics.joint_best_of(metrics.final_displacement(distance), 100).tolist()
    assert len(errors["ade"]) == 303
    assert np.mean(errors["ade"]) == pytest.approx(0.37, rel=0.1)
    assert np.mean(errors["fde"]) == pytest.approx(0.72, rel=0.1)


def test_it_is_for_the_papers_sets_alone() -> None:
    with pytest.raises(ContenderError, match="alone, not on plaza"):
        resolve(NAME, "plaza", [walk()])


# --- the fence


def test_no_registry_and_no_checkpoint_reader_takes_it(tmp_path: Path) -> None:
    saving.save(tmp_path / "leaky", network(), {})
    assert not [name for name in registry.names() if "leaky" in name]
    with pytest.raises(CheckpointError, match="neither a bundled model"):
        registry.load(NAME)
    for path in (tmp_path / "leaky", tmp_path / "leaky.json"):
        with pytest.raises(CheckpointError, match="not the JSON of a checkpoint"):
            Checkpoint.load(path)


def test_its_name_in_tables_is_a_warning() -> None:
    assert "future" in LeakyPredictor(network(), [walk()]).name


def test_its_row_carries_the_warning(eth_ucy: EthUcy, tmp_path: Path) -> None:
    plan = EvaluationPlan(
        (NAME,), ("zara1",), protocol="paper", samples=2, kde_samples=2, max_windows=2
    )
    evaluation = run(plan, tmp_path, data=eth_ucy.folder)
    assert "paper-leaky (inputs contain the future)" in evaluation.to_markdown()
    (row,) = evaluation.rows
    assert row.sets[0].model == "paper-leaky (inputs contain the future)"


def test_it_forecasts_no_window_but_the_papers() -> None:
    recording = walk()
    predictor = LeakyPredictor(network(), [recording])
    (window, *_) = protocols.sgan(recording)
    with pytest.raises(PlanError, match="the protocol 'paper' alone"):
        predictor.predict([replace(window, first=3)], num_samples=1, seed=0)
    stranger = replace(window, recording=replace(recording, name="elsewhere"))
    with pytest.raises(PlanError, match="knows no chunk of elsewhere"):
        predictor.predict([stranger], num_samples=1, seed=0)


def test_forecasts_do_not_depend_on_the_windows_beside() -> None:
    recording = walk()
    predictor = LeakyPredictor(network(), [recording])
    windows: list[Window] = protocols.paper(recording)
    together = predictor.predict(windows, num_samples=4, seed=3)
    (alone,) = predictor.predict(windows[-1:], num_samples=4, seed=3)
    agents = len(windows[-1].judged)
    assert alone.samples.shape == (4, agents, 12, 2)
    assert alone.mean.shape == alone.mode_mean.shape == (agents, 12, 2)
    assert np.array_equal(together[-1].samples, alone.samples)
