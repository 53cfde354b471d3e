"""Batch evaluations over both transports: one suite, a small model, recordings sent along."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import grpc
import httpx
import pytest
import pytest_asyncio
from tests.contract.drivers import CODES, Json, RefusalError
from tests.contract.evaluation_drivers import (
    EvaluationDriver,
    GrpcEvaluationDriver,
    HttpEvaluationDriver,
)
from tests.contract.recordings import walkers
from tests.contract.servers import MAX_MESSAGE_BYTES, small_settings

from trajectron_service.evaluations import queue
from trajectron_service.evaluations.messages import EvaluationProgress
from trajectron_service.http_evaluation_schemas import Evaluation, Evaluations
from trajectron_service.lifecycle import Service, running

pytestmark = [pytest.mark.asyncio(loop_scope="session"), pytest.mark.timeout(400)]

QUEUE_SIZE = 2
# The small model does not say what it was trained on.
QUICK: Json = {
    "models": ["small", "constant-velocity"], "num_samples": 3, "seed": 5, "in_sample": True,
}  # fmt: skip


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the service keeps its evaluations."""
    return tmp_path_factory.mktemp("state")


@pytest_asyncio.fixture(scope="module", loop_scope="session")
async def judge(model_path: Path, state: Path) -> AsyncIterator[Service]:
    """A service with a short queue and without the data set."""
    settings = small_settings(
        model_path,
        state_dir=state,
        data=None,
        evaluation_queue_size=QUEUE_SIZE,
        evaluation_priority="normal",
        request_timeout_s=120.0,
    )
    async with running(settings) as service:
        yield service


@pytest_asyncio.fixture(loop_scope="session", params=["http", "grpc"])
async def driver(request: pytest.FixtureRequest, judge: Service) -> AsyncIterator[EvaluationDriver]:
    """Each transport in turn; what a test leaves behind is removed."""
    async with (
        httpx.AsyncClient(base_url=f"http://127.0.0.1:{judge.http_port}", timeout=200.0) as http,
        grpc.aio.insecure_channel(f"127.0.0.1:{judge.grpc_port}") as channel,
    ):
        over: EvaluationDriver = (
            HttpEvaluationDriver(http) if request.param == "http" else GrpcEvaluationDriver(channel)
        )
        yield over
        for left in (await over.list_page())["evaluations"]:
            await over.delete(left["id"])


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> asyncio.Event:
    """Evaluations run without doing anything until this is set, and then succeed."""
    release = asyncio.Event()

    async def wait(
        _folder: object, _data: object, _background: object, note: Callable[[Any], object]
    ) -> None:
        note(EvaluationProgress(0.5, 5, 10, "small", "square", 1.5))
        await release.wait()

    monkeypatch.setattr(queue, "carry_out", wait)
    return release


def refused(error: RefusalError, kind: str, driver: EvaluationDriver) -> None:
    """The error is of the kind, in the transport's own code."""
    codes = CODES | {
        "UNKNOWN_EVALUATION": {"http": "404", "grpc": "NOT_FOUND"},
        "EVALUATION_EXISTS": {"http": "409", "grpc": "ALREADY_EXISTS"},
        "EVALUATION_HAS_NO_RESULT": {"http": "409", "grpc": "FAILED_PRECONDITION"},
        "DATASET_UNAVAILABLE": {"http": "409", "grpc": "FAILED_PRECONDITION"},
    }
    assert (error.kind, error.code) == (kind, codes[kind][driver.name])


async def until(driver: EvaluationDriver, evaluation_id: str, state: str) -> Json:
    """The evaluation once it is in a state."""
    async for seen in driver.watch(evaluation_id):
        if seen["state"] == state:
            return seen
    raise AssertionError(f"it has never been {state}: {seen}")


async def test_an_uploaded_recording_is_judged_and_its_result_comes_in_every_form(
    driver: EvaluationDriver,
) -> None:
    created = await driver.create({"square.csv": walkers()}, evaluation_id="first", **QUICK)
    Evaluation.model_validate_json(json.dumps(created))
    assert created["id"] == "first"
    assert (created["state"], created["files"], created["sets"]) == (
        "queued", ["square.csv"], ["square"],
    )  # fmt: skip
    seen = [one async for one in driver.watch("first")]
    order = ["queued", "running", "succeeded"]
    states = [one["state"] for one in seen]
    assert states == sorted(states, key=order.index)
    assert states[-1] == "succeeded"
    shares = [one["progress"]["share"] for one in seen]
    assert shares == sorted(shares)
    last = seen[-1]["progress"]
    assert (last["share"], last["windows_done"]) == (1.0, last["windows_total"])
    assert last["windows_total"] == 2 * 5  # windows of 20 steps of 24, once for each model
    assert await driver.get("first") == seen[-1]

    content, kind = await driver.result("first", "json")
    assert kind == "application/json"
    assert [row["name"] for row in json.loads(content)["rows"]] == QUICK["models"]
    content, kind = await driver.result("first", "csv")
    assert kind == "text/csv; charset=utf-8"
    assert content.startswith(b"entry,set,")
    content, kind = await driver.result("first", "html")
    assert kind == "text/html; charset=utf-8"
    assert b"data:image/svg" in content and b"<script" not in content


@pytest.mark.usefixtures("held")
async def test_what_is_deleted_is_gone_with_its_files(
    driver: EvaluationDriver, state: Path
) -> None:
    before = set((state / "evaluations").iterdir())
    await driver.create({"square.csv": walkers()}, evaluation_id="gone", **QUICK)
    assert set((state / "evaluations").iterdir()) != before
    watched = asyncio.create_task(until(driver, "gone", "cancelled"))
    await until(driver, "gone", "running")
    await driver.delete("gone")
    assert set((state / "evaluations").iterdir()) == before
    for ask in (driver.get("gone"), driver.delete("gone"), driver.cancel("gone"),
                driver.result("gone", "json"), anext(driver.watch("gone"))):  # fmt: skip
        with pytest.raises(RefusalError) as caught:
            await ask
        refused(caught.value, "UNKNOWN_EVALUATION", driver)
    # Whoever watched it is told, in an event or an error, and waits no longer.
    with pytest.raises((RefusalError, AssertionError), match="UNKNOWN_EVALUATION"):
        await watched


async def test_an_unreadable_recording_is_refused_with_file_line_and_reason(
    driver: EvaluationDriver, state: Path
) -> None:
    before = set((state / "evaluations").iterdir())
    lines = walkers().split(b"\n")
    lines[16] = b"2.0,0,pedestrian,far,1.0"
    files = {"good.csv": walkers(), "bad.csv": b"\n".join(lines)}
    with pytest.raises(RefusalError) as caught:
        await driver.create(files, **QUICK)
    refused(caught.value, "INVALID_ARGUMENT", driver)
    assert caught.value.fields == ("files[1]",)
    assert "bad.csv: line 17: x is 'far', not a number" in caught.value.message
    assert (await driver.list_page())["evaluations"] == []
    assert set((state / "evaluations").iterdir()) == before


@pytest.mark.parametrize(
    ("changes", "kind", "field"),
    [
        ({"models": []}, "INVALID_ARGUMENT", "models"),
        ({"models": ["small", "small"]}, "INVALID_ARGUMENT", "models[1]"),
        ({"models": ["small", "nobody"]}, "UNKNOWN_MODEL", "models[1]"),
        ({"models": ["../small"]}, "UNKNOWN_MODEL", "models[0]"),
        ({"models": ["small@best"]}, "UNKNOWN_MODEL", "models[0]"),
        ({"models": ["linear@z_best"]}, "UNKNOWN_MODEL", "models[0]"),
        ({"models": ["linear", "leave-one-out@z_best"]}, "INVALID_ARGUMENT", "models[1]"),
        ({"num_samples": 0}, "INVALID_ARGUMENT", "num_samples"),
        ({"num_samples": 2001}, "INVALID_ARGUMENT", "num_samples"),
        ({"seed": 2**63}, "INVALID_ARGUMENT", "seed"),
        ({"max_windows": 0}, "INVALID_ARGUMENT", "max_windows"),
        ({"frames_per_step": 0}, "INVALID_ARGUMENT", "frames_per_step"),
        ({"sets": ["eth"]}, "INVALID_ARGUMENT", "sets"),
        ({"dataset": "eth_ucy"}, "INVALID_ARGUMENT", "dataset"),
        ({"evaluation_id": "a/b"}, "INVALID_ARGUMENT", "evaluation_id"),
        ({"request_id": "k" * 129}, "INVALID_ARGUMENT", "request_id"),
        ({"files": {"crowd.py": walkers()}}, "INVALID_ARGUMENT", "files[0].name"),
        ({"files": {"../crowd.csv": walkers()}}, "INVALID_ARGUMENT", "files[0].name"),
        ({"files": {"a.csv": walkers(), "a.txt": walkers()}}, "INVALID_ARGUMENT", "files[1].name"),
    ],
)  # fmt: skip
async def test_what_cannot_be_asked_is_refused_by_field(
    driver: EvaluationDriver, changes: Json, kind: str, field: str
) -> None:
    request: dict[str, Any] = {"files": {"crowd.csv": walkers()}, **QUICK, **changes}
    with pytest.raises(RefusalError) as caught:
        await driver.create(request.pop("files"), request.pop("request_id", ""), **request)
    refused(caught.value, kind, driver)
    assert caught.value.fields == (field,)


@pytest.mark.parametrize(
    ("dataset", "kind"),
    [("", "INVALID_ARGUMENT"), ("moon", "INVALID_ARGUMENT"), ("eth_ucy", "DATASET_UNAVAILABLE")],
)
async def test_a_data_set_that_is_not_there_is_refused(
    driver: EvaluationDriver, dataset: str, kind: str
) -> None:
    with pytest.raises(RefusalError) as caught:
        await driver.create(dataset=dataset, **QUICK)
    refused(caught.value, kind, driver)
    assert caught.value.fields == ("dataset",)


@pytest.mark.usefixtures("held")
async def test_a_request_sent_twice_makes_one_evaluation(driver: EvaluationDriver) -> None:
    files = {"square.csv": walkers()}
    first = await driver.create(files, "key-1", **QUICK)
    again = await driver.create(files, "key-1", **QUICK)
    assert again["id"] == first["id"]
    assert len((await driver.list_page())["evaluations"]) == 1
    with pytest.raises(RefusalError) as caught:
        await driver.create({"square.csv": walkers(seed=1)}, "key-1", **QUICK)
    refused(caught.value, "INVALID_ARGUMENT", driver)
    with pytest.raises(RefusalError) as caught:
        await driver.create(files, evaluation_id=first["id"], **QUICK)
    refused(caught.value, "EVALUATION_EXISTS", driver)


async def test_one_runs_few_wait_and_more_are_refused(
    driver: EvaluationDriver, held: asyncio.Event
) -> None:
    await driver.create({"square.csv": walkers()}, evaluation_id="busy", **QUICK)
    async for seen in driver.watch("busy"):
        if seen["progress"]["share"]:
            assert seen["state"] == "running"
            assert seen["progress"] == {
                "share": 0.5, "windows_done": 5, "windows_total": 10,
                "model": "small", "set": "square", "seconds_left": 1.5,
            }  # fmt: skip
            break
    names = ["a", "b"]
    for name in names:
        created = await driver.create({"square.csv": walkers()}, evaluation_id=name, **QUICK)
        assert created["state"] == "queued"
    with pytest.raises(RefusalError) as caught:
        await driver.create({"square.csv": walkers()}, **QUICK)
    refused(caught.value, "OVERLOADED", driver)
    assert caught.value.retry_after_s is not None

    with pytest.raises(RefusalError) as caught:
        await driver.result("busy", "json")
    refused(caught.value, "EVALUATION_HAS_NO_RESULT", driver)
    for name in ("b", "busy"):
        assert (await driver.cancel(name))["state"] == "cancelled"
        with pytest.raises(RefusalError) as caught:
            await driver.result(name, "html")
        refused(caught.value, "EVALUATION_HAS_NO_RESULT", driver)
    # The place is free again; what has ended stays as it is.
    held.set()
    assert (await until(driver, "a", "succeeded"))["error"] == ""
    assert (await driver.cancel("a"))["state"] == "succeeded"
    assert (await driver.get("b"))["start_time"] is None


async def test_a_recording_without_windows_fails_and_says_why(driver: EvaluationDriver) -> None:
    created = await driver.create({"short.csv": walkers(steps=10)}, **QUICK)
    failed = await until(driver, created["id"], "failed")
    assert "short has no window of the protocol sgan" in failed["error"]
    assert failed["end_time"] is not None


@pytest.mark.usefixtures("held")
async def test_lists_run_over_pages_the_newest_first(driver: EvaluationDriver) -> None:
    for name in ("c", "a", "b"):
        await driver.create({"square.csv": walkers()}, evaluation_id=name, **QUICK)
        await driver.cancel(name)
    first = await driver.list_page(2)
    Evaluations.model_validate_json(json.dumps(first))
    assert [one["id"] for one in first["evaluations"]] == ["b", "a"]
    second = await driver.list_page(2, first["next_page_token"])
    assert [one["id"] for one in second["evaluations"]] == ["c"]
    assert second["next_page_token"] == ""
    for size, token, field in ((0, "", "page_size"), (1, "b", "page_token"), (1, "YQ==", "page_token")):  # fmt: skip  # noqa: E501
        with pytest.raises(RefusalError) as caught:
            await driver.list_page(size, token)
        assert caught.value.fields == (field,)


async def test_an_upload_beyond_the_limit_is_refused(driver: EvaluationDriver) -> None:
    files = {"large.csv": b"x" * (MAX_MESSAGE_BYTES + 1)}
    if isinstance(driver, HttpEvaluationDriver):
        with pytest.raises(RefusalError) as caught:
            await driver.create(files, **QUICK)
        refused(caught.value, "TOO_LARGE", driver)
    else:
        # gRPC itself refuses it, before it is a message.
        with pytest.raises(KeyError):
            await driver.create(files, **QUICK)
    assert (await driver.list_page())["evaluations"] == []
