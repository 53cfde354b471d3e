"""Modes placed by the kernel are torch's, and an agent's do not depend on who stands beside it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from trajectron_model.config import Dispersion
from trajectron_model.kernels import in_use, kernels
from trajectron_model.kernels.loading import without
from trajectron_model.modes import Rollouts, place

pytestmark = pytest.mark.skipif(kernels() is None, reason=in_use())

UNIT = 0.4 * 5.0
DISPERSIONS = {
    "none": (),
    "one": (Dispersion(0.7, 1.5),),
    "many": tuple(Dispersion(0.4 + 0.01 * t, 2.0 - 0.3 * t) for t in range(12)),
    "extreme": (Dispersion(1.0, 300.0), Dispersion(1.0, -300.0)),
}


def rollouts(nodes: int = 6, modes: int = 7, horizon: int = 12) -> Rollouts:
    torch.manual_seed(nodes + modes + horizon)
    rows = nodes * modes
    root = 0.2 * torch.randn(rows, horizon, 2, 2)
    spread = root @ root.mT + 1e-4 * torch.eye(2)
    angle = torch.rand(nodes) * 6.0
    return Rollouts(
        velocity=torch.randn(rows, horizon, 2),
        increment=torch.stack([spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]], dim=-1),
        row=torch.arange(rows).reshape(nodes, modes),
        probability=torch.softmax(torch.randn(nodes, modes), dim=-1),
        axis=torch.stack([angle.cos(), angle.sin()], dim=-1),
        turned=torch.arange(nodes) % 3 == 1,
    )


def placed(asked: Rollouts, dispersion: tuple[Dispersion, ...]) -> tuple[Tensor, Tensor]:
    with torch.inference_mode():
        return place(asked, UNIT, dispersion)


@pytest.mark.parametrize("name", DISPERSIONS)
@pytest.mark.parametrize("shape", [(6, 7, 12), (1, 1, 1), (2, 25, 60), (3, 2, 17)])
def test_modes_are_torchs(name: str, shape: tuple[int, int, int]) -> None:
    asked = rollouts(*shape)
    ours = placed(asked, DISPERSIONS[name])
    with without():
        theirs = placed(asked, DISPERSIONS[name])
    for one, other in zip(ours, theirs, strict=True):
        scale = float(other.abs().max())
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-6 * scale)
    xx, xy, yy = ours[1].double().unbind(-1)
    assert (xx * yy > xy.square()).all()


def test_a_mode_left_out_repeats_another_and_counts_for_nothing() -> None:
    asked = rollouts()
    row, probability = asked.row.clone(), asked.probability.clone()
    row[2, 3], probability[2, 3] = row[2, 0], 0.0
    asked = asked._replace(row=row, probability=probability)
    mean, covariance = placed(asked, DISPERSIONS["many"])
    assert torch.equal(mean[2, 3], mean[2, 0]) and torch.equal(covariance[2, 3], covariance[2, 0])
    with without():
        theirs = placed(asked, DISPERSIONS["many"])
    torch.testing.assert_close(covariance, theirs[1], rtol=1e-3, atol=1e-4)


def test_an_agents_modes_do_not_depend_on_who_stands_beside_it() -> None:
    asked = rollouts()
    everything = placed(asked, DISPERSIONS["many"])
    for agent in range(6):
        alone = asked._replace(
            **{
                name: getattr(asked, name)[agent : agent + 1]
                for name in ("row", "probability", "axis", "turned")
            }
        )
        for one, all_ in zip(placed(alone, DISPERSIONS["many"]), everything, strict=True):
            assert torch.equal(one[0], all_[agent])


def test_what_is_no_number_stays_none_and_stays_alone() -> None:
    asked = rollouts()
    asked.velocity[8, 4, 0] = torch.nan
    mean, covariance = placed(asked, DISPERSIONS["one"])
    assert mean[1, 1, 4:].isnan().any() or covariance[1, 1, 4:].isnan().any()
    assert not mean[[0, 2, 3, 4, 5]].isnan().any()


@pytest.mark.parametrize("wrong", [-1, 42])
def test_rows_that_no_rollout_has_are_refused(wrong: int) -> None:
    asked = rollouts()
    row = asked.row.clone()
    row[0, 0] = wrong
    with pytest.raises(IndexError):
        placed(asked._replace(row=row), ())


def test_nobody_has_no_modes() -> None:
    asked = rollouts()
    none = asked._replace(
        **{name: getattr(asked, name)[:0] for name in ("row", "probability", "axis", "turned")}
    )
    assert placed(none, ())[0].shape == (0, 7, 12, 2)
