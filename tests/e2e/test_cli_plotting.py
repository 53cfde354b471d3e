"""The picture of a forecast shows what it should, whatever the scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from trajectron_service.messages import AgentForecast, Forecast, ForecastMode
from trajectron_service.plotting import draw

Z, H, S = 8, 6, 5


def agent(
    name: str, x: float, y: float, *, samples: bool = True, modes: bool = True
) -> AgentForecast:
    """Somebody who goes right; the modes fan out."""
    ahead = np.linspace(0.5, 3.0, H)
    fan = np.linspace(-1.0, 1.0, Z)
    mean = np.stack([np.stack([ahead, slope * ahead], axis=1) for slope in fan])  # [Z, H, 2]
    return AgentForecast(
        id=name,
        type="pedestrian",
        x=x,
        y=y,
        last_observed_time=2.0,
        observations=4,
        heading_known=True,
        mode_probabilities=np.full(Z, 1 / Z, dtype=np.float32),
        mean=mean.astype(np.float32) if modes else None,
        covariance=np.tile(np.array([0.04, 0.01, 0.02], np.float32), (Z, H, 1)) if modes else None,
        samples=mean[:S].astype(np.float32) if samples else None,
        sample_modes=np.arange(S) if samples else None,
    )


def forecast(*agents: AgentForecast) -> Forecast:
    offsets = tuple(0.4 * (step + 1) for step in range(H))
    return Forecast("small", "ff", ForecastMode.FULL, 0, 2.0, offsets, agents)


HISTORY = np.array([[-1.0, 0.0], [-0.5, 0.0], [0.0, 0.0]])


def colours(file: Path) -> set[tuple[int, ...]]:
    """The colours of a picture that fill more than a speck of it."""
    pixels = (imread(file)[::2, ::2, :3] * 255).round().astype(int)
    codes, counts = np.unique(pixels @ [1 << 16, 1 << 8, 1], return_counts=True)
    common = codes[counts > 10].tolist()
    return {(code >> 16, code >> 8 & 255, code & 255) for code in common}


@pytest.mark.parametrize(
    ("samples", "modes"), [(True, True), (True, False), (False, True), (False, False)]
)
def test_any_kind_of_forecast_is_drawn(tmp_path: Path, samples: bool, modes: bool) -> None:
    file = tmp_path / "scene.png"
    one = agent("7", 0.0, 0.0, samples=samples, modes=modes)
    draw(
        file,
        forecast(one),
        {"7": HISTORY},
        futures={"7": HISTORY + np.array([2.0, 0.0])},
        title="t",
    )
    assert len(colours(file)) > 5


def test_modes_have_colours_of_their_own(tmp_path: Path) -> None:
    file = tmp_path / "scene.png"
    draw(file, forecast(agent("7", 0.0, 0.0)), {"7": HISTORY})
    blue, orange, teal = (0, 119, 187), (238, 119, 51), (0, 153, 136)
    assert {blue, orange, teal} <= colours(file)  # in the legend, where nothing is blended


def test_an_empty_scene_and_a_crowd_are_drawn(tmp_path: Path) -> None:
    draw(tmp_path / "empty.png", forecast(), {})
    crowd = [agent(str(n), float(n % 9), float(n // 9)) for n in range(70)]
    draw(tmp_path / "crowd.png", forecast(*crowd), {})
    assert imread(tmp_path / "empty.png").size
    assert imread(tmp_path / "crowd.png").size


def test_far_from_the_origin_the_picture_is_the_same(tmp_path: Path) -> None:
    near, far = tmp_path / "near.png", tmp_path / "far.png"
    draw(near, forecast(agent("7", 0.0, 0.0)), {"7": HISTORY})
    draw(far, forecast(agent("7", 4e6, 5e6)), {"7": HISTORY + np.array([4e6, 5e6])})
    one, other = imread(near), imread(far)
    assert abs(one.shape[0] - other.shape[0]) < 60
    assert abs((one < 0.5).mean() - (other < 0.5).mean()) < 0.02


def test_metres_are_as_long_along_both_axes(tmp_path: Path) -> None:
    """A wide scene makes a wide picture, a tall one a tall picture."""
    wide, tall = tmp_path / "wide.png", tmp_path / "tall.png"
    draw(wide, forecast(agent("a", 0.0, 0.0), agent("b", 30.0, 0.0)), {})
    draw(tall, forecast(agent("a", 0.0, 0.0), agent("b", 0.0, 30.0)), {})
    assert imread(wide).shape[1] > 1.5 * imread(wide).shape[0]
    assert imread(tall).shape[0] > imread(tall).shape[1]
