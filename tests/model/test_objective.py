"""The ELBO and the marginal likelihood that it bounds, computed by hand where one can."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from trajectron_model.config import ModelConfig
from trajectron_model.history import History
from trajectron_model.latent import categorical_kl
from trajectron_model.training.examples import Batch
from trajectron_model.training.objective import LossTerms, ObjectiveSettings, loss_terms
from trajectron_model.trajectron import Trajectron

SMALL = ModelConfig(latent_values=5, mixture_components=3, decoder_size=16, horizon=4)


@pytest.fixture
def network() -> Trajectron:
    torch.manual_seed(1)
    return Trajectron(SMALL)


def batch(known_steps: tuple[int, ...] = (4, 4, 2)) -> Batch:
    random = np.random.default_rng(0)
    nodes, steps = 3, 5
    track = random.normal(0.0, 0.3, (steps + 4, nodes, 2)).cumsum(axis=0)
    zeros = np.zeros(nodes, dtype=np.int64)
    past = History(track[:steps], np.ones((steps, nodes), dtype=bool), zeros, zeros)
    known = np.arange(4) < np.array(known_steps)[:, None]
    future = track[steps:].transpose(1, 0, 2)
    return Batch(past, np.arange(nodes), future, known)


def terms(network: Trajectron, examples: Batch, beta: float = 1.0, **settings: object) -> LossTerms:
    chosen = ObjectiveSettings(label_noise_mps=0.0, **settings)  # type: ignore[arg-type]
    return loss_terms(network, examples, chosen, beta=beta, random=np.random.default_rng(0))


def test_the_elbo_bounds_the_likelihood(network: Trajectron) -> None:
    found = terms(network, batch(), name="elbo")
    assert found.reconstruction + found.kl >= found.nll
    assert found.kl >= 0.0


def test_the_bound_is_tight_when_the_recognition_is_the_posterior() -> None:
    log_prior = torch.log_softmax(torch.randn(4, 5), dim=-1)
    log_prob = torch.randn(4, 5) * 3.0
    log_q = torch.log_softmax(log_prior + log_prob, dim=-1)
    elbo = (log_q.exp() * log_prob).sum(-1) - categorical_kl(log_q, log_prior)
    torch.testing.assert_close(elbo, torch.logsumexp(log_prior + log_prob, dim=-1))


def test_beta_weighs_the_divergence(network: Trajectron) -> None:
    """loss = (reconstruction + beta kl) / steps, for futures of 4, 4 and 2 known steps."""
    steps = (4 + 4 + 2) / 3
    for beta in (0.0, 0.3, 2.0):
        found = terms(network, batch(), name="elbo", beta=beta)
        expected = (found.reconstruction + beta * found.kl) / steps
        torch.testing.assert_close(found.loss.detach(), expected)


def test_steps_that_are_not_known_do_not_count(network: Trajectron) -> None:
    examples = batch()
    elsewhere = examples._replace(future=examples.future.copy())
    elsewhere.future[2, 2:] += 100.0
    for name in ("elbo", "marginal"):
        one, other = (terms(network, e, name=name) for e in (examples, elsewhere))
        torch.testing.assert_close(one.nll, other.nll)
        torch.testing.assert_close(one.loss, other.loss)


def test_the_divergence_of_two_categoricals() -> None:
    log_q = torch.log(torch.tensor([0.5, 0.5]))
    log_p = torch.log(torch.tensor([0.25, 0.75]))
    expected = 0.5 * math.log(2.0) + 0.5 * math.log(2.0 / 3.0)
    assert categorical_kl(log_q, log_p).item() == pytest.approx(expected)


def test_beta_ramps_over_its_share_of_the_training() -> None:
    settings = ObjectiveSettings(beta_start=0.1, beta_end=0.5, beta_ramp=0.5)
    assert [settings.beta(p) for p in (0.0, 0.25, 0.5, 1.0)] == pytest.approx([0.1, 0.3, 0.5, 0.5])


@pytest.mark.parametrize("name", ["elbo", "marginal"])
def test_every_network_learns_from_the_objective(network: Trajectron, name: str) -> None:
    terms(network, batch(), name=name).loss.backward()
    without = [
        parameter
        for parameter, value in network.named_parameters()
        if value.grad is None or not value.grad.abs().sum() > 0.0
    ]
    # With one edge type the softmax over edge types is 1 whatever its scores.
    assert all("attention" in parameter for parameter in without)


def test_the_likelihood_is_of_the_true_velocities(network: Trajectron) -> None:
    """-log sum_z p(z|x) prod_t p(y_t|y_<t,z,x), each factor by a decoder stepped by hand."""
    examples = batch((4, 4, 4))
    found = terms(network, examples)
    with torch.no_grad():
        encoded = network.encode(examples.past, examples.rows)
        nodes = network.node_model(0)
        prior = nodes.latent.prior(encoded.encoding)
        last = torch.from_numpy(examples.past.position[-1])
        track = torch.cat([last.unsqueeze(1), torch.from_numpy(examples.future)], dim=1)
        world = (track.diff(dim=1) / SMALL.dt_s).float()
        total = 0.0
        for agent in range(3):
            c, s = encoded.motion.heading[agent]
            turn = torch.stack([torch.stack([c, s]), torch.stack([-s, c])])
            own = world[agent] @ turn.T
            each = []
            for z in range(5):
                previous = (turn @ encoded.motion.velocity[agent]).unsqueeze(0)
                start = nodes.decoder.start(
                    nodes.decoder.prepare(encoded.encoding[[agent]], previous),
                    torch.tensor([0]),
                    torch.tensor([z]),
                )
                h, cell, log_prob = start.hidden, start.cell, torch.zeros(())
                for step in range(4):
                    h, cell = nodes.decoder.cell(start, previous, h, cell)
                    mixture = nodes.decoder.mixture(h, previous)
                    previous = own[step].unsqueeze(0)
                    log_prob = log_prob + mixture.log_prob(previous)[0]
                each.append(prior[agent, z] + log_prob)
            total -= torch.logsumexp(torch.stack(each), dim=0).item()
    assert found.nll.item() == pytest.approx(total / 3, rel=1e-4)
