"""Nothing is lost: the service is killed and drained under streaming load (a short form)."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests import redis_server
from tests.contract.servers import save_small_model

from benchmarks.crash import crash
from benchmarks.handover import handover

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A small model with random weights."""
    return str(save_small_model(tmp_path_factory.mktemp("models") / "small"))


def test_killed_again_and_again_it_goes_on_as_if_nothing_had_happened(
    model: str, tmp_path: Path
) -> None:
    result, restarts = crash(5, 3, tmp_path, alone=True, seed=1, model=model)
    assert len(restarts) == 5
    assert result.reconnects >= 5 * 3
    assert result.forecasts > 0
    assert result.exact, result


def test_sessions_move_between_replicas_mid_stream(model: str, tmp_path: Path) -> None:
    with redis_server.running(tmp_path) as url:
        result, stood_s = handover(1, 1, 3, tmp_path, url, seed=1, model=model)
    assert (len(stood_s["kill"]), len(stood_s["drain"])) == (1, 1)
    assert result.reconnects >= 2 * 3
    assert result.forecasts > 0
    assert result.exact, result
