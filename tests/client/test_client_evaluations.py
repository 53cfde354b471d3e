"""Evaluations through the client library against the real service, both transports alike.

What an evaluation measures is tested end to end; these are cancelled as soon as they have begun.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.contract.recordings import walkers
from tests.process import Served

import trajectron_client as tc
from trajectron_client.sync_calls import SyncCalls

CROWD = tc.RecordingFile("crowd.csv", walkers())


@pytest.fixture(params=["grpc", "http"])
def client(request: pytest.FixtureRequest, served: Served) -> Iterator[SyncCalls]:
    """Each transport in turn; what a test leaves behind is removed."""
    with (
        tc.Client(served.grpc_target, timeout_s=60.0)
        if request.param == "grpc"
        else tc.HttpClient(served.http_url, timeout_s=60.0)
    ) as one:
        yield one
        for left in one.list_evaluations():
            one.delete_evaluation(left.id)


def test_an_evaluation_is_created_watched_and_cancelled(client: SyncCalls, tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_bytes(walkers())
    created = client.create_evaluation(
        ["small", "constant-velocity"], files=[CROWD, path], protocol="all", num_samples=7,
        seed=2**40, in_sample=True, max_windows=3,
    )  # fmt: skip
    assert created.models == ("small", "constant-velocity")
    assert (created.dataset, created.sets) == ("", ("crowd", "walk"))
    assert created.files == ("crowd.csv", "walk.csv")
    assert (created.protocol, created.num_samples, created.seed) == ("all", 7, 2**40)
    assert (created.in_sample, created.max_windows, created.frames_per_step) == (True, 3, 10)
    assert created.state is tc.EvaluationState.QUEUED
    assert created.progress.seconds_left is None
    assert created.ended_at is None

    for seen in client.watch_evaluation(created.id):
        if seen.state is tc.EvaluationState.RUNNING:
            break
    with pytest.raises(tc.NoResultError):
        client.evaluation_result(created.id)
    cancelled = client.cancel_evaluation(created.id)
    assert cancelled.state is tc.EvaluationState.CANCELLED
    assert cancelled.ended_at is not None and cancelled.ended_at >= created.created_at
    assert client.get_evaluation(created.id) == cancelled
    assert list(client.watch_evaluation(created.id)) == [cancelled]
    client.delete_evaluation(created.id)
    with pytest.raises(tc.UnknownEvaluationError):
        client.get_evaluation(created.id)
    with pytest.raises(tc.UnknownEvaluationError):
        next(iter(client.watch_evaluation(created.id)))


def test_lists_of_evaluations_run_over_pages(client: SyncCalls) -> None:
    for name in ("a", "b", "c"):
        client.create_evaluation(["constant-velocity"], files=[CROWD], evaluation_id=name)
        client.cancel_evaluation(name)
    assert [one.id for one in client.list_evaluations(page_size=2)] == ["c", "b", "a"]


def test_refusals_of_evaluations_come_as_their_own_classes(client: SyncCalls) -> None:
    models = ["constant-velocity"]
    client.create_evaluation(models, files=[CROWD], evaluation_id="taken", request_id="k")
    again = client.create_evaluation(models, files=[CROWD], evaluation_id="taken", request_id="k")
    assert again.id == "taken"
    with pytest.raises(tc.EvaluationExistsError):
        client.create_evaluation(models, files=[CROWD], evaluation_id="taken")
    with pytest.raises(tc.UnknownModelError):
        client.create_evaluation(["nobody"], files=[CROWD])
    broken = tc.RecordingFile("broken.csv", b"time,id,type,x,y\n0,1,pedestrian,0\n")
    with pytest.raises(tc.InvalidArgumentError) as caught:
        client.create_evaluation(models, files=[broken])
    assert [violation.field for violation in caught.value.violations] == ["files[0]"]
    assert "broken.csv: line 2" in caught.value.message
    with pytest.raises(TypeError, match="sample"):
        client.create_evaluation(models, files=[CROWD], sample=3)  # type: ignore[call-arg] # on purpose


async def test_the_asyncio_clients_watch_as_well(served: Served) -> None:
    async with (
        tc.AsyncClient(served.grpc_target, timeout_s=60.0) as over_grpc,
        tc.AsyncHttpClient(served.http_url, timeout_s=60.0) as over_http,
    ):
        created = await over_http.create_evaluation(["constant-velocity"], files=[CROWD])
        await over_grpc.cancel_evaluation(created.id)
        for one in (over_grpc, over_http):
            seen = [state.state async for state in one.watch_evaluation(created.id)]
            assert seen == [tc.EvaluationState.CANCELLED]
            assert created.id in [each.id async for each in one.list_evaluations()]
        await over_http.delete_evaluation(created.id)
        with pytest.raises(tc.UnknownEvaluationError):
            await anext(over_http.watch_evaluation(created.id))
