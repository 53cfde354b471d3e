"""The bivariate mixture against torch.distributions and against its own samples."""

from __future__ import annotations

import torch
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from trajectron_model.gmm import BivariateMixture, choose, merge_moments


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


def test_samples_have_the_moments_of_the_mixture() -> None:
    ours = mixture(batch=2)
    random = torch.Generator().manual_seed(2)
    count = 200_000
    many = BivariateMixture(*(v.expand(count, *v.shape) for v in ours))
    drawn = many.sample(
        torch.rand(count, 2, generator=random), torch.randn(count, 2, 2, generator=random)
    )
    mean, covariance = ours.moments()
    torch.testing.assert_close(drawn.mean(0), mean, atol=0.01, rtol=0.01)
    for batch in range(2):
        torch.testing.assert_close(
            drawn[:, batch].T.cov(), full(covariance)[batch], atol=0.02, rtol=0.02
        )


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
