"""Scenes changed for training: mirrored, stretched, played at another pace."""

from __future__ import annotations

import numpy as np
import pytest

from trajectron_model.training import augmentation

NOW, STEPS = 7, 25


class Drawn(np.random.Generator):
    """A generator whose uniform numbers are given."""

    def __init__(self, *numbers: float) -> None:
        super().__init__(np.random.PCG64(0))
        self._numbers = list(numbers)

    def uniform(self, *_: object, **__: object) -> float:  # type: ignore[override]
        return self._numbers.pop(0)


def walkers() -> np.ndarray:
    """[T, 2, 2] one walks along x at a metre a step, one stands; x counts the steps."""
    steps = np.arange(STEPS, dtype=float)
    return np.stack(
        [np.stack([steps, 0.0 * steps], -1), np.stack([0.0 * steps, 0.0 * steps + 5.0], -1)], 1
    )


def test_a_film_that_slows_down_ends_at_the_pace_drawn() -> None:
    played = augmentation.paced(walkers(), NOW, Drawn(np.log(0.5), 0.0))
    step = np.diff(played[:, 0, 0])
    np.testing.assert_allclose(played[: NOW + 1], walkers()[: NOW + 1])
    np.testing.assert_allclose(step[NOW + 6 :], 0.5)
    halves = 0.5 ** (np.arange(7) / 6.0)
    np.testing.assert_allclose(step[NOW : NOW + 6], 0.5 * (halves[1:] + halves[:-1]))


def test_a_film_that_hastens_reaches_frames_beyond_and_knows_none_after_them() -> None:
    played = augmentation.paced(walkers(), NOW, Drawn(augmentation.FASTEST, -3.0))
    horizon = STEPS - NOW - 1 - augmentation.steps_beyond(12)
    assert horizon == 12
    assert not np.isnan(played[NOW : NOW + 1 + horizon]).any()
    assert np.isnan(played[-1]).all()
    assert played[NOW + horizon, 0, 0] > NOW + horizon + 3.0


def test_who_stands_stays_and_paths_are_kept() -> None:
    random = np.random.default_rng(4)
    scene = walkers()
    scene[:, 0, 1] = np.sin(scene[:, 0, 0])
    for _ in range(20):
        played = augmentation.paced(scene, NOW, random)
        known = ~np.isnan(played[:, 0, 0])
        np.testing.assert_allclose(played[known, 1], [[0.0, 5.0]] * known.sum())
        on_path = np.interp(played[known, 0, 0], scene[:, 0, 0], scene[:, 0, 1])
        np.testing.assert_allclose(played[known, 0, 1], on_path, atol=1e-12)
        np.testing.assert_array_equal(played[NOW], scene[NOW])


def test_a_frame_between_is_unknown_where_either_is() -> None:
    scene = walkers()
    scene[NOW + 4, 0] = np.nan
    played = augmentation.paced(scene, NOW, Drawn(np.log(0.5), -3.0))
    whole = augmentation.paced(walkers(), NOW, Drawn(np.log(0.5), -3.0))
    touched = np.abs(whole[:, 0, 0] - (NOW + 4)) < 1.0
    assert touched.sum() >= 2
    np.testing.assert_array_equal(np.isnan(played[:, 0, 0]), touched | np.isnan(whole[:, 0, 0]))
    np.testing.assert_array_equal(played[:, 1], whole[:, 1])


def test_what_is_observed_sees_nothing_later() -> None:
    scene = walkers()
    later = scene.copy()
    later[NOW + 1 :] += 9.0
    for seed in range(20):
        first, second = (
            augmentation.paced(one, NOW, np.random.default_rng(seed)) for one in (scene, later)
        )
        np.testing.assert_array_equal(first[: NOW + 1], second[: NOW + 1])


@pytest.mark.parametrize("scale", [0.3, 1.0])
def test_stretching_keeps_within_its_bounds(scale: float) -> None:
    random = np.random.default_rng(0)
    factors = [augmentation.stretched(np.ones(2), scale, random)[0] for _ in range(400)]
    assert 1.0 / (1.0 + scale) <= min(factors) < 0.9
    assert 1.1 < max(factors) <= 1.0 + scale


def test_half_of_the_scenes_are_mirrored() -> None:
    random = np.random.default_rng(0)
    images = [augmentation.mirrored(np.array([1.0, 2.0]), random).tolist() for _ in range(400)]
    assert 160 < images.count([1.0, -2.0]) < 240
    assert images.count([1.0, 2.0]) == 400 - images.count([1.0, -2.0])
