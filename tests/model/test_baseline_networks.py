"""The networks of the baselines: what they see, how they pool, what they give out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from trajectron_model.baselines.gaussian import BivariateGaussian, from_outputs
from trajectron_model.baselines.lstm import Lstm, LstmPredictor
from trajectron_model.baselines.network import NetworkPredictor, SceneNetwork
from trajectron_model.baselines.recipes import NETWORKS
from trajectron_model.baselines.scenes import (
    Scene,
    SceneBatch,
    displacements,
    observed_scene,
    pairs_of,
    stack,
)
from trajectron_model.baselines.sgan import Generator
from trajectron_model.baselines.sgan_training import Discriminator, SganUpdate, variety_loss
from trajectron_model.baselines.social_attention import SocialAttention, nearest
from trajectron_model.baselines.social_lstm import SocialLstm, grid_cell, social_tensor
from trajectron_model.baselines.stepping import SteppingNetwork
from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, sgan_windows

NAN = np.nan


def crowd(agents: int = 5, steps: int = 24, seed: int = 0, apart_m: float = 1.0) -> Recording:
    """Walkers side by side."""
    random = np.random.default_rng(seed)
    walks = random.normal([0.5, 0.0], 0.1, (steps, agents, 2)).cumsum(axis=0)
    walks += np.arange(agents)[:, None] * [0.0, apart_m]
    step, agent = np.indices((steps, agents)).reshape(2, -1)
    return Recording.from_rows(
        name="crowd",
        dt_s=0.4,
        start_time_s=0.0,
        ids=[str(n) for n in range(agents)],
        types=["pedestrian"] * agents,
        step=step,
        agent=agent,
        position=walks.reshape(-1, 2),
    )


def random_network(name: str) -> SceneNetwork:
    torch.manual_seed(1)
    network = NETWORKS[name]()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(1.5)
    return network.eval()


def whole_batch(windows: list[Window]) -> SceneBatch:
    return stack([observed_scene(window, future=True) for window in windows])


def test_displacement_is_since_last_seen_and_zero_at_first_sight() -> None:
    track = np.array([[NAN, NAN], [1.0, 1.0], [1.5, 1.0], [NAN, NAN], [2.5, 3.0]])
    expected = [[0.0, 0.0], [0.0, 0.0], [0.5, 0.0], [0.0, 0.0], [0.5, 1.0]]
    np.testing.assert_allclose(displacements(track[:, None])[:, 0], expected)


def test_a_scene_has_eight_steps_whatever_was_observed() -> None:
    recording = crowd()
    short = observed_scene(Window(recording, 3, 2, 12, np.array([1, 2])))
    assert short.position.shape == (8, 5, 2) and np.isnan(short.position[:6]).all()
    long = observed_scene(Window(recording, 0, 10, 12, np.array([1, 2])))
    _, dense = recording.dense(2, 10)
    np.testing.assert_allclose(long.position + long.origin, dense)
    np.testing.assert_allclose(long.last_observed(), dense[-1, [1, 2]])
    alone = observed_scene(Window(recording, 0, 10, 12, np.array([1, 2])), context=False)
    np.testing.assert_allclose(alone.position, long.position[:, [1, 2]])


def test_a_crowd_is_cut_to_those_nearest_a_judged_agent() -> None:
    position = np.full((8, 4, 2), NAN)
    position[:, :, 1] = [0.0, 5.0, 1.0, NAN]
    position[:, :3, 0] = 0.0
    cut = Scene(position, np.array([0, 1]), np.zeros(2)).around(0, 2)
    np.testing.assert_allclose(cut.position[-1, :, 1], [0.0, 1.0])
    assert cut.judged.tolist() == [0]


def test_pairs_are_those_within_a_scene() -> None:
    pairs = pairs_of(torch.tensor([0, 0, 0, 1, 2, 2]))
    assert list(zip(pairs.receiver.tolist(), pairs.sender.tolist(), strict=True)) == [
        (0, 1),
        (0, 2),
        (1, 0),
        (1, 2),
        (2, 0),
        (2, 1),
        (4, 5),
        (5, 4),
    ]


def test_the_gaussian_is_the_textbook_one() -> None:
    gaussian = BivariateGaussian(
        torch.tensor([1.0, -1.0]), torch.tensor([0.5, 2.0]), torch.tensor(0.6)
    )
    covariance = torch.tensor([[0.25, 0.6], [0.6, 4.0]])
    textbook = torch.distributions.MultivariateNormal(gaussian.mean, covariance)
    places = torch.tensor([[1.0, -1.0], [0.2, 1.5]])
    torch.testing.assert_close(gaussian.log_prob(places), textbook.log_prob(places))
    drawn = gaussian.sample(torch.randn(50_000, 2, generator=torch.Generator().manual_seed(0)))
    torch.testing.assert_close(torch.cov(drawn.T), covariance, atol=0.06, rtol=0.03)


def test_no_output_makes_a_gaussian_degenerate() -> None:
    extreme = from_outputs(torch.tensor([[0.0, 0.0, -1e4, 1e4, 1e4]]))
    assert extreme.scale[0, 0] == pytest.approx(0.02)
    assert torch.isfinite(extreme.log_prob(torch.zeros(1, 2))).all()


@pytest.mark.parametrize(
    ("offset", "cell"),
    [
        ((0.0, 0.0), 10),
        ((-2.0, -2.0), 0),
        ((1.99, -0.5), 13),
        ((-0.5, 1.5), 7),
        ((2.0, 0.0), -1),
        ((0.0, -2.01), -1),
    ],
)
def test_the_grid_has_half_open_cells_of_a_metre(offset: tuple[float, float], cell: int) -> None:
    assert grid_cell(torch.tensor(offset), cells=4, width_m=4.0).item() == cell


def test_social_tensor_sums_those_in_a_cell() -> None:
    """By hand: two in one cell of agent 0, one outside, one absent; the other scene is apart."""
    position = torch.tensor([[[0.0, 0.0], [0.5, 0.5], [0.9, 0.1], [9.0, 0.0], [-0.5, 0.5]]])
    position = torch.cat([position, position], dim=1)
    hidden = torch.arange(1.0, 11.0)[None, :, None].expand(1, 10, 3)
    pairs = pairs_of(torch.tensor([0] * 5 + [1] * 5))
    present = torch.tensor([True, True, True, True, False] * 2)
    seen = present[pairs.receiver] & present[pairs.sender]
    tensor = social_tensor(hidden, position, pairs, seen, cells=4, width_m=4.0)
    cells = tensor.view(10, 16, 3)[..., 0]
    expected = torch.zeros(16)
    expected[10] = 2.0 + 3.0
    torch.testing.assert_close(cells[0], expected)
    expected[10] = 7.0 + 8.0
    torch.testing.assert_close(cells[5], expected)
    assert cells[3].abs().sum() == 0 and cells[4].abs().sum() == 0
    assert cells[1, 5] == 1.0, "agent 0 stands behind and to the right of agent 1"


def test_the_nearest_are_attended_to() -> None:
    batch = whole_batch(sgan_windows(crowd(agents=4))[:1])
    position = batch.position.clone()
    position[7] = torch.tensor([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0], [3.5, 0.0]])
    row, exists = nearest(batch._replace(position=position), 2)
    assert row.tolist() == [[1, 2], [0, 2], [3, 1], [2, 1]] and exists.all()
    gone = batch.present.clone()
    gone[7, 1] = False
    row, exists = nearest(batch._replace(position=position, present=gone), 3)
    assert exists.sum(1).tolist() == [2, 0, 2, 2] and row[0, :2].tolist() == [2, 3]


def test_attention_is_a_softmax_scaled_by_the_number_of_edges() -> None:
    network = SocialAttention(hidden=2, edge_hidden=2, attention=2)
    with torch.no_grad():
        network.query.weight.copy_(torch.eye(2))
        network.key.weight.copy_(torch.eye(2))
    temporal = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]])
    edges = torch.tensor([[[[1.0, 0.0], [0.0, 5.0]], [[1.0, 0.0], [0.0, 5.0]]]])
    seen = torch.tensor([[True, True], [False, False]])
    weight = network.attention(temporal, edges, seen)[0]
    share = math.exp(2 / math.sqrt(2))
    torch.testing.assert_close(weight[0], torch.tensor([share, 1.0]) / (share + 1.0))
    assert weight[1].tolist() == [0.0, 0.0], "nobody there, nobody attended to"


def test_pooling_of_social_gan_is_a_maximum_over_those_present() -> None:
    network = random_network("sgan")
    assert isinstance(network, Generator)
    encoded, position = torch.randn(3, 32), torch.randn(3, 2)
    present = torch.tensor([True, True, False])
    pooled = network.pool(encoded, position, present, torch.zeros(3, dtype=torch.int64))

    def each(receiver: int, sender: int) -> Tensor:
        offset = network.embed_offset(position[sender] - position[receiver])
        pooled_one: Tensor = network.pooling(torch.cat([offset, encoded[sender]]))
        return pooled_one

    torch.testing.assert_close(pooled[0], torch.maximum(each(0, 0), each(0, 1)))
    torch.testing.assert_close(pooled[1], torch.maximum(each(1, 1), each(1, 0)))
    torch.testing.assert_close(pooled[2], each(2, 2))


def test_the_variety_loss_takes_the_best_sample_of_each_scene() -> None:
    """Two agents share a scene and must share a sample; the third is alone."""
    truth = torch.zeros(3, 2, 2)
    offsets = torch.zeros(2, 3, 2, 2)
    offsets[0, :, :, 0] = torch.tensor([[1.0, 1.0], [0.0, 0.0], [3.0, 0.0]])
    offsets[1, :, :, 0] = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 0.0]])
    loss = variety_loss(offsets, truth, torch.tensor([0, 0, 1]))
    assert float(loss) == pytest.approx((min(2 + 0, 0 + 4) + min(9, 4)) / 6)


@pytest.mark.parametrize("name", NETWORKS)
def test_others_matter_only_to_networks_that_look_at_them(name: str) -> None:
    network = random_network(name)
    window = sgan_windows(crowd())[0]
    predictor = NetworkPredictor(network, name)
    (among,) = predictor.predict([replace(window, judged=np.array([2]))], num_samples=1, seed=0)
    lonely = crowd()
    kept = lonely.agent == 2
    alone = replace(
        lonely, step=lonely.step[kept], agent=lonely.agent[kept], position=lonely.position[kept]
    )
    (without,) = predictor.predict(
        [replace(window, recording=alone, judged=np.array([2]))], num_samples=1, seed=0
    )
    same = np.allclose(among.mean, without.mean, atol=1e-4)
    assert same == (name == "lstm")


@pytest.mark.parametrize("name", ["lstm", "social-lstm", "social-attention"])
def test_feeding_back_the_truth_gives_the_trained_likelihood(name: str) -> None:
    """The first step foretold is the one that training's pass over whole tracks judges."""
    network = random_network(name)
    assert isinstance(network, SteppingNetwork)
    batch = whole_batch(sgan_windows(crowd())[:2])
    with torch.no_grad():
        likelihood = network.log_likelihood(batch)
        first = network.point_forecast(batch, 1)[:, 0]
        links = network.links(batch)
        state = network.blank(batch, links)
        for step in range(8):
            state = network.advance(
                state,
                links,
                batch.position[step][None],
                batch.displacement[step][None],
                batch.present[step],
            )
        gaussian = network.gaussian(state[0])
    torch.testing.assert_close(gaussian.mean[0], first)
    torch.testing.assert_close(gaussian.log_prob(batch.displacement[8][None])[0], likelihood[7])
    assert likelihood.shape == (19, len(batch.scene))


def test_unknown_steps_weigh_nothing_in_the_likelihood() -> None:
    batch = whole_batch(sgan_windows(crowd())[:1])
    present = batch.present.clone()
    present[:5, 0] = False
    network = random_network("lstm")
    assert isinstance(network, SteppingNetwork)
    with torch.no_grad():
        likelihood = network.log_likelihood(batch._replace(present=present))
    assert (likelihood[:5, 0] == 0).all() and (likelihood[5:, 0] != 0).all()


def test_log_prob_of_the_lstm_is_over_the_foretold_steps() -> None:
    network = random_network("lstm")
    assert isinstance(network, Lstm)
    window = sgan_windows(crowd())[1]
    predictor = LstmPredictor(network, "lstm")
    (density,) = predictor.log_prob([window])
    with torch.no_grad():
        expected = network.log_likelihood(whole_batch([window]))[7:].sum(0)
    np.testing.assert_allclose(density, expected, rtol=1e-4)
    (incomplete,) = predictor.log_prob([replace(window, first=window.first + 12)])
    assert np.isnan(incomplete).all()


def test_many_samples_are_drawn_in_parts_that_change_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    predictor = NetworkPredictor(random_network("social-lstm"), "social-lstm")
    windows = sgan_windows(crowd())
    whole = predictor.predict(windows, num_samples=7, seed=2)
    monkeypatch.setattr("trajectron_model.baselines.network._MAX_ROWS", 11)
    for one, other in zip(whole, predictor.predict(windows, num_samples=7, seed=2), strict=True):
        np.testing.assert_allclose(one.samples, other.samples, atol=1e-4)


def test_samples_of_social_gan_share_their_noise_in_a_scene() -> None:
    network = random_network("sgan")
    noise = network.draw_noise(np.random.default_rng(0), agents=3, samples=4, horizon=12)
    assert noise.shape == (4, 3, 8)
    assert (noise == noise[:, :1]).all() and not (noise[0] == noise[1]).any()
    (forecast,) = NetworkPredictor(network, "sgan").predict(
        sgan_windows(crowd())[:1], num_samples=6, seed=0
    )
    np.testing.assert_allclose(forecast.mean, forecast.samples.mean(axis=0), atol=1e-4)


def test_an_adversary_learns_to_tell_and_the_generator_to_come_near() -> None:
    windows = sgan_windows(crowd(steps=40))
    batch = whole_batch(windows[:4])
    torch.manual_seed(0)
    update = SganUpdate(Generator(), seed=0)
    losses = [update(batch, 5e-3) for _ in range(12)]
    assert losses[-1] < 0.5 * losses[0]
    assert Discriminator()(batch.displacement).shape == (len(batch.scene),)


def test_a_recording_of_another_dt_is_refused() -> None:
    window = sgan_windows(replace(crowd(), dt_s=0.5))[0]
    with pytest.raises(ValueError, match=r"crowd has steps of 0\.5 s; sgan works at 0\.4 s"):
        NetworkPredictor(random_network("sgan"), "sgan").predict([window], num_samples=1, seed=0)


def test_social_lstm_has_the_grid_of_its_paper() -> None:
    network = SocialLstm()
    assert network.embed_others[0].in_features == 4 * 4 * network.hidden_size
