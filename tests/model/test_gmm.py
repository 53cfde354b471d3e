"""The bivariate mixture against torch.distributions and against its own samples."""

from __future__ import annotations

import torch
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from trajectron_model.gmm import BivariateMixture, choose, correlated, merge_moments


def mixture(batch: int = 5, components: int = 4) -> BivariateMixture:
    random = torch.Generator().manual_seed(0)
    return BivariateMixture(
        torch.log_softmax(torch.randn(batch, components, generator=random), dim=-1),
        torch.randn(batch, components, 2, generator=random),
        torch.rand(batch, components, 2, generator=random) + 0.2,
        torch.rand(batch, components, generator=random) * 1.8 - 0.9,
    )


def full(covariance: torch.Tensor) -> torch.Tensor:
    matrix: torch.Tensor = covariance[..., [0, 1, 1, 2]].unflatten(-1, (2, 2))
    return matrix


def test_density_is_that_of_torch_distributions() -> None:
    ours = mixture()
    theirs = MixtureSameFamily(
        Categorical(logits=ours.log_weights),
        MultivariateNormal(ours.mean, full(ours.covariance())),
    )
    value = torch.randn(5, 2, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(ours.log_prob(value), theirs.log_prob(value))


def test_correlated_values_have_the_moments_asked_for() -> None:
    ours = mixture(batch=1, components=3)
    normal = torch.randn(400_000, 3, 2, generator=torch.Generator().manual_seed(2))
    drawn = correlated(ours.mean[0], ours.scale[0], ours.correlation[0], normal)
    torch.testing.assert_close(drawn.mean(0), ours.mean[0], atol=0.01, rtol=0.0)
    for component in range(3):
        expected = full(ours.covariance())[0, component]
        torch.testing.assert_close(drawn[:, component].T.cov(), expected, atol=0.01, rtol=0.01)


def test_merging_two_equal_halves_adds_the_spread_of_their_means() -> None:
    mean, covariance = merge_moments(
        torch.tensor([0.5, 0.5]),
        torch.tensor([[-1.0, 0.0], [1.0, 0.0]]),
        torch.tensor([[0.25, 0.0, 0.25], [0.25, 0.0, 0.25]]),
    )
    assert mean.tolist() == [0.0, 0.0]
    assert covariance.tolist() == [1.25, 0.0, 0.25]


def test_choice_inverts_the_cumulative_distribution() -> None:
    weights = torch.tensor([0.25, 0.0, 0.75]).expand(4, 3)
    uniform = torch.tensor([0.0, 0.2499, 0.25, 0.999999])
    assert choose(weights, uniform).tolist() == [0, 0, 2, 2]
