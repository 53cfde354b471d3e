"""A batch evaluation through the running service: killed, taken up again, and equal to one offline.

Real processes throughout: the service, and beside it the process of the evaluation.
"""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
import torch
from tests.contract.servers import save_small_model
from tests.process import LOG, STOP_S, Served, launch

from trajectron_client import Client, EvaluationState, HttpClient, NoResultError
from trajectron_model.evaluation.plan import EvaluationPlan
from trajectron_model.evaluation.run import run
from trajectron_service.cli import main

# Generous: a machine that is busy otherwise takes its time to import torch, three times.
pytestmark = pytest.mark.timeout(1800)
PATIENCE_S = 900.0

MODELS = ("small", "constant-velocity-noise")
SAMPLES = 50
SEED = 7
# Several, so that there is something between them: each makes a shard of every model.
FILES = ("one.csv", "two.csv", "three.csv")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small model and simulated crossings."""
    folder = tmp_path_factory.mktemp("evaluations")
    save_small_model(folder / "small")
    (folder / "recordings").mkdir()
    for seed, name in enumerate(FILES):
        with pytest.raises(SystemExit) as left:
            main(
                ["simulate", "crossing", "--agents", "8", "--seconds", "12", "--seed", str(seed),
                 "--output", str(folder / "recordings" / name)]
            )  # fmt: skip
        assert not left.value.code
    return folder


@pytest.fixture(scope="module")
def offline(folder: Path) -> str:
    """The result of the same plan and seed without a service, as JSON."""
    plan = EvaluationPlan(
        entries=MODELS,
        files=tuple(f"recordings/{name}" for name in FILES),
        samples=SAMPLES,
        seed=SEED,
        in_sample=True,
    )
    torch.set_num_threads(1)  # as the service's own process has
    with pytest.MonkeyPatch.context() as patch:
        # The service names recordings and models by places relative to the evaluation's own.
        patch.chdir(folder)
        run(plan, folder / "offline")
    return (folder / "offline" / "result.json").read_text()


def create(served: Served, folder: Path, name: str) -> None:
    """Queues the evaluation."""
    with HttpClient(served.http_url, timeout_s=PATIENCE_S) as client:
        client.create_evaluation(
            MODELS,
            files=[folder / "recordings" / name for name in FILES],
            evaluation_id=name,
            num_samples=SAMPLES,
            seed=SEED,
            in_sample=True,
        )


def test_killed_on_the_way_it_goes_on_and_gives_the_figures_of_an_offline_run(
    folder: Path, offline: str
) -> None:
    state = folder / "state"
    settings = {
        "state_dir": str(state), "evaluation_priority": "normal", "request_timeout_s": "600",
    }  # fmt: skip
    process, served = launch(folder / "small", folder, settings, PATIENCE_S)
    try:
        create(served, folder, "walk")
        with HttpClient(served.http_url) as client:
            for seen in client.watch_evaluation("walk", timeout_s=PATIENCE_S):
                assert not seen.state.ended, seen.error
                if seen.progress.windows_done:
                    break
            with pytest.raises(NoResultError):
                client.evaluation_result("walk")
        process.kill()
    finally:
        process.kill()
        process.wait()
    done = {file: file.stat().st_mtime_ns for file in state.glob("evaluations/*/run/shards/*.npz")}
    assert done

    process, served = launch(folder / "small", folder, settings, PATIENCE_S)
    try:
        with Client(served.grpc_target) as client:
            *_, last = client.watch_evaluation("walk", timeout_s=PATIENCE_S)
            assert last.state is EvaluationState.SUCCEEDED, last.error
            assert client.evaluation_result("walk") == offline.encode()
            assert b",nll_kde," in client.evaluation_result("walk", "csv")
            assert b"data:image/svg" in client.evaluation_result("walk", "html")
            # What was done before the kill was not done again.
            assert {file: file.stat().st_mtime_ns for file in done} == done

            # A service that stops ends the process beside it, and waits for no evaluation.
            create(served, folder, "again")
            for seen in client.watch_evaluation("again"):
                if seen.state is EvaluationState.RUNNING:
                    break
        process.send_signal(signal.SIGTERM)
        assert process.wait(STOP_S) == 0, (folder / LOG).read_text()
    finally:
        process.kill()
        process.wait()


def test_an_offline_result_names_what_was_judged(offline: str) -> None:
    result = json.loads(offline)
    assert [row["name"] for row in result["rows"]] == list(MODELS)
    assert result["fingerprint"]["plan"]["files"] == [f"recordings/{name}" for name in FILES]
