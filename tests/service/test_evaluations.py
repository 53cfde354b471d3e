"""Batch evaluations without a transport: their life, their order, and what survives a stop."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import signal
import sqlite3
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from tests.contract.recordings import walkers
from tests.contract.servers import save_small_model

from trajectron_model import registry
from trajectron_service import tenancy
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.evaluations import queue, worker
from trajectron_service.evaluations.background import Background, told
from trajectron_service.evaluations.folders import EvaluationFolder
from trajectron_service.evaluations.jobs import Evaluations
from trajectron_service.evaluations.launch import Priority
from trajectron_service.evaluations.messages import (
    EvaluationConfig,
    EvaluationInfo,
    EvaluationProgress,
    EvaluationState,
    RecordingFile,
    ResultFormat,
)
from trajectron_service.evaluations.requests import EvaluationChoices
from trajectron_service.evaluations.running import FailedError
from trajectron_service.evaluations.store import EvaluationStore, StoredEvaluation
from trajectron_service.metrics import Metrics
from trajectron_service.settings import Settings, SettingsError
from trajectron_service.work import WorkInHand

Run = Callable[[EvaluationFolder, Callable[[EvaluationProgress], object]], Any]

WAIT_S = 30.0
ASKED = EvaluationConfig(models=("constant-velocity",), dataset="eth_ucy", sets=("street",))
DATA = {
    "seconds_per_frame": 0.04,
    "frames_per_step": 10,
    "recordings": {},
    "test_sets": {"street": [], "park": []},
    "training": {},
}


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """A folder for the state, and a data set of two sets."""
    data = tmp_path / "data"
    data.mkdir()
    (data / "splits.json").write_text(json.dumps(DATA))
    return Settings(state_dir=tmp_path / "state", data=data, evaluation_priority="normal")


@asynccontextmanager
async def opened(settings: Settings) -> AsyncIterator[Evaluations]:
    """Evaluations as a service has them from its start to its stop."""
    metrics = Metrics()
    evaluations = Evaluations(settings, metrics, WorkInHand(metrics))
    try:
        await evaluations.start()
        yield evaluations
    finally:
        await evaluations.close()


@pytest.fixture
def carried(monkeypatch: pytest.MonkeyPatch) -> Callable[[Run], None]:
    """Sets what becomes of an evaluation that is started, in place of a process."""

    def use(run: Run) -> None:
        async def carry_out(
            folder: EvaluationFolder,
            _data: Path | None,
            _background: Background,
            note: Callable[[EvaluationProgress], object],
        ) -> None:
            await run(folder, note)

        monkeypatch.setattr(queue, "carry_out", carry_out)

    return use


async def forever(_folder: EvaluationFolder, note: Callable[[EvaluationProgress], object]) -> None:
    """Comes to a quarter of the way."""
    note(EvaluationProgress(0.25, 1, 4, "constant-velocity", "street", 3.0))
    await asyncio.Event().wait()


async def at_once(folder: EvaluationFolder, _note: Callable[[EvaluationProgress], object]) -> None:
    """Succeeds with a result."""
    (folder.run / "result.json").write_bytes(b"{}")


async def create(evaluations: Evaluations, name: str = "", **changes: Any) -> EvaluationInfo:
    """An evaluation of the street."""
    return await evaluations.create(name, ASKED, (), "", **changes)


async def until(evaluations: Evaluations, name: str, *states: EvaluationState) -> EvaluationInfo:
    """The evaluation once it is in one of the states."""
    async for info in evaluations.watch(name):
        if info.state in states:
            return info
    raise AssertionError(f"{name} ended as {info.state}: {info.error}")


async def test_evaluations_run_one_after_another_in_order(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    order: list[str] = []
    active: set[str] = set()

    async def note_order(folder: EvaluationFolder, _note: object) -> None:
        order.append(folder.path.name)
        active.add(folder.path.name)
        await asyncio.sleep(0.01)
        assert active == {folder.path.name}
        active.clear()

    carried(note_order)
    async with opened(settings) as evaluations:
        for name in ("z", "a", "m"):
            await create(evaluations, name)
        for name in ("z", "a", "m"):
            ended = await until(evaluations, name, EvaluationState.SUCCEEDED)
            assert ended.ended_at is not None and ended.started_at is not None
            assert ended.created_at <= ended.started_at <= ended.ended_at
    assert order == ["00000001", "00000002", "00000003"]


async def test_what_runs_or_waits_at_the_stop_is_taken_up_at_the_next_start(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    carried(forever)
    async with opened(settings) as evaluations:
        await create(evaluations, "running")
        await create(evaluations, "waiting")
        await create(evaluations, "cancelled")
        await evaluations.cancel("cancelled")
        first = await until(evaluations, "running", EvaluationState.RUNNING)
    carried(at_once)
    async with opened(settings) as evaluations:
        again = await until(evaluations, "running", EvaluationState.SUCCEEDED)
        assert (again.created_at, again.started_at) == (first.created_at, first.started_at)
        await until(evaluations, "waiting", EvaluationState.SUCCEEDED)
        assert (await evaluations.get("cancelled")).state is EvaluationState.CANCELLED
    async with opened(settings) as evaluations:
        assert await evaluations.get("running") == again
        assert (await evaluations.result("running", ResultFormat.JSON)).content == b"{}"


async def test_without_a_folder_nothing_outlives_the_service(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    carried(at_once)
    alone = settings.model_copy(update={"state_dir": None})
    async with opened(alone) as evaluations:
        await create(evaluations, "a")
        await until(evaluations, "a", EvaluationState.SUCCEEDED)
        folder = evaluations._archive.folder(1).path
        assert folder.is_dir()
    assert not folder.exists()
    async with opened(alone) as evaluations:
        assert await evaluations.list_page(None, "") == ((), "")


async def test_pages_tell_nothing_of_other_tenants(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    carried(forever)

    async def pages_of_ann(evaluations: Evaluations) -> tuple[list[str], list[str]]:
        tenancy.enter("ann")
        ids: list[str] = []
        tokens: list[str] = []
        token = ""
        while True:
            page, token = await evaluations.list_page(1, token)
            ids += [info.id for info in page]
            if not token:
                return ids, tokens
            tokens.append(base64.urlsafe_b64decode(token).decode())

    async def made(evaluations: Evaluations, tenant: str, name: str) -> EvaluationInfo:
        tenancy.enter(tenant)
        return await create(evaluations, name)

    async with opened(settings) as evaluations:
        at = {}
        for tenant, name in [("bob", "x"), ("ann", "1"), ("bob", "y"), ("ann", "2"), ("ann", "3")]:
            info = await asyncio.create_task(made(evaluations, tenant, name))
            at[name] = info.created_at
        ids, tokens = await asyncio.create_task(pages_of_ann(evaluations))
        assert ids == ["3", "2", "1"]
        assert tokens == [f"{at['3']!r} 3", f"{at['2']!r} 2"]  # what ann has seen, and no count


@pytest.mark.parametrize("place", ["2", "2 ", "nan a", "inf a", "x a", ""])
async def test_page_tokens_of_nobodys_are_refused(settings: Settings, place: str) -> None:
    token = base64.urlsafe_b64encode(place.encode()).decode() or "="
    async with opened(settings) as evaluations:
        with pytest.raises(ServiceError, match="page_token"):
            await evaluations.list_page(1, token)


async def test_two_services_do_not_share_a_folder(settings: Settings) -> None:
    async with opened(settings):
        with pytest.raises(SettingsError, match=r"state_dir: .*another service"):
            async with opened(settings):
                pass
    async with opened(settings):
        pass


async def test_a_folder_that_is_no_store_of_ours_is_told(settings: Settings) -> None:
    assert settings.state_dir is not None
    settings.state_dir.mkdir()
    (settings.state_dir / "evaluations.sqlite").write_bytes(b"no database" * 100)
    with pytest.raises(SettingsError, match=r"state_dir: .*evaluations\.sqlite"):
        async with opened(settings):
            pass


async def test_files_that_belong_to_no_evaluation_are_swept_up(settings: Settings) -> None:
    assert settings.state_dir is not None
    left = settings.state_dir / "evaluations" / "00000007" / "work"
    left.mkdir(parents=True)
    async with opened(settings) as evaluations:
        assert not left.parent.exists()
        assert await evaluations.list_page(None, "") == ((), "")


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (FailedError("street has no windows"), "street has no windows"),
        (ZeroDivisionError("1/0"), "a fault of the service; its log has more"),
    ],
)
async def test_what_fails_says_why_and_the_next_one_runs(
    settings: Settings, carried: Callable[[Run], None], fault: Exception, reason: str
) -> None:
    async def fail(_folder: EvaluationFolder, _note: object) -> None:
        raise fault

    async with opened(settings) as evaluations:
        carried(fail)
        await create(evaluations, "a")
        failed = await until(evaluations, "a", EvaluationState.FAILED)
        assert failed.error == reason
        with pytest.raises(ServiceError) as caught:
            await evaluations.result("a", ResultFormat.JSON)
        assert caught.value.kind is ErrorKind.EVALUATION_HAS_NO_RESULT
        carried(at_once)
        await create(evaluations, "b")
        await until(evaluations, "b", EvaluationState.SUCCEEDED)


async def test_a_client_that_goes_away_leaves_no_files_behind(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    reading = asyncio.Event()

    async def check(*_arguments: object) -> None:
        reading.set()
        await asyncio.Event().wait()

    monkeypatch.setattr("trajectron_service.evaluations.jobs.check_recordings", check)
    asked = EvaluationConfig(models=("constant-velocity",))
    async with opened(settings) as evaluations:
        file = RecordingFile("a.csv", walkers())
        creating = asyncio.create_task(evaluations.create("a", asked, (file,), ""))
        await reading.wait()
        folder = evaluations._archive.folder(1).path
        assert folder.is_dir()
        creating.cancel()
        with pytest.raises(asyncio.CancelledError):
            await creating
        assert not folder.exists()
        assert evaluations._entering.total() == 0


class Gate:
    """Lets a thread pass once it is opened, and tells the event loop when one has come."""

    def __init__(self) -> None:
        self._reached = threading.Event()
        self._opened = threading.Event()

    def pass_through(self) -> None:
        """Waits until the gate is opened."""
        self._reached.set()
        assert self._opened.wait(WAIT_S)

    def open(self) -> None:
        """Lets everybody through from now on."""
        self._opened.set()

    async def reached(self) -> None:
        """Returns when a thread has come."""
        assert await asyncio.to_thread(self._reached.wait, WAIT_S)


@pytest.fixture
def before_fill(monkeypatch: pytest.MonkeyPatch) -> Gate:
    """Closed to whoever lays down an evaluation's files."""
    gate, fill = Gate(), EvaluationFolder.fill

    def fill_behind(folder: EvaluationFolder, *what: Any) -> None:
        gate.pass_through()
        fill(folder, *what)

    monkeypatch.setattr(EvaluationFolder, "fill", fill_behind)
    return gate


@pytest.fixture
def before_record(monkeypatch: pytest.MonkeyPatch) -> Gate:
    """Closed to whoever writes a new record."""
    gate, add = Gate(), EvaluationStore.add

    async def add_behind(store: EvaluationStore, stored: StoredEvaluation) -> None:
        await store._on_thread(gate.pass_through)
        await add(store, stored)

    monkeypatch.setattr(EvaluationStore, "add", add_behind)
    return gate


def folders(settings: Settings) -> list[str]:
    """The folders of evaluations that there are."""
    assert settings.state_dir is not None
    return sorted(path.name for path in (settings.state_dir / "evaluations").iterdir())


async def test_files_being_laid_down_for_a_client_that_goes_away_are_removed_after_that(
    settings: Settings, carried: Callable[[Run], None], before_fill: Gate
) -> None:
    carried(forever)
    async with opened(settings) as evaluations:
        creating = asyncio.create_task(create(evaluations, "a"))
        await before_fill.reached()
        next_one = asyncio.create_task(create(evaluations, "b"))
        creating.cancel()
        await asyncio.sleep(0.05)
        creating.cancel()  # whoever insists has to wait as well
        before_fill.open()
        with pytest.raises(asyncio.CancelledError):
            await creating
        await next_one
        assert folders(settings) == ["00000002"]


async def test_a_stop_waits_for_the_files_of_a_client_that_has_gone_away(
    settings: Settings, before_fill: Gate
) -> None:
    async with opened(settings) as evaluations:
        creating = asyncio.create_task(create(evaluations, "a"))
        await before_fill.reached()
        creating.cancel()
        asyncio.get_running_loop().call_later(0.05, before_fill.open)
    assert folders(settings) == []
    assert creating.cancelled()


async def test_recordings_that_take_too_long_are_refused_and_leave_no_files(
    settings: Settings, before_fill: Gate
) -> None:
    async with opened(settings.model_copy(update={"request_timeout_s": 0.05})) as evaluations:
        creating = asyncio.create_task(create(evaluations, "a"))
        asyncio.get_running_loop().call_later(0.2, before_fill.open)
        with pytest.raises(ServiceError) as caught:
            await creating
        assert caught.value.kind is ErrorKind.DEADLINE_EXCEEDED
        assert folders(settings) == []


async def test_a_request_cut_off_while_it_is_recorded_makes_its_one_evaluation(
    settings: Settings, carried: Callable[[Run], None], before_record: Gate
) -> None:
    carried(forever)
    async with opened(settings) as evaluations:
        creating = asyncio.create_task(evaluations.create("", ASKED, (), "key"))
        await before_record.reached()
        creating.cancel()
        again = asyncio.create_task(evaluations.create("", ASKED, (), "key"))
        other = asyncio.create_task(create(evaluations, "other"))
        await asyncio.sleep(0.05)
        before_record.open()
        with pytest.raises(asyncio.CancelledError):
            await creating
        kept, _ = await evaluations.list_page(None, "")
        assert [info.id for info in kept] == [(await again).id]
        await other
        assert folders(settings) == ["00000001", "00000002"]
    async with opened(settings) as evaluations:
        kept, _ = await evaluations.list_page(None, "")
        assert [info.id for info in kept] == ["other", (await again).id]


async def test_an_evaluation_that_cannot_be_recorded_leaves_no_files(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with opened(settings) as evaluations:
        monkeypatch.setattr(EvaluationStore, "add", full_disk)
        with pytest.raises(sqlite3.OperationalError):
            await create(evaluations, "a")
        assert folders(settings) == []
        assert await evaluations.list_page(None, "") == ((), "")


async def full_disk(_store: EvaluationStore, _stored: StoredEvaluation) -> None:
    """As the store fails on a full disk."""
    raise sqlite3.OperationalError("database or disk is full")


async def test_what_is_created_while_another_is_being_deleted_has_its_own_files(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    ending, ended = asyncio.Event(), asyncio.Event()

    async def end_slowly(_folder: EvaluationFolder, _note: object) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ending.set()
            await ended.wait()

    carried(end_slowly)
    async with opened(settings) as evaluations:
        await create(evaluations, "a")
        await until(evaluations, "a", EvaluationState.RUNNING)
        deleting = asyncio.create_task(evaluations.delete("a"))
        await ending.wait()
        await create(evaluations, "a")  # the id is free as soon as the record is gone
        ended.set()
        await deleting
        assert folders(settings) == ["00000002"]
        assert (await evaluations.get("a")).state is not EvaluationState.SUCCEEDED


async def test_an_id_is_taken_until_its_record_is_gone(
    settings: Settings, carried: Callable[[Run], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    carried(at_once)
    gate, delete = Gate(), EvaluationStore.delete

    async def delete_behind(store: EvaluationStore, stored: StoredEvaluation) -> None:
        await store._on_thread(gate.pass_through)
        await delete(store, stored)

    async with opened(settings) as evaluations:
        await create(evaluations, "a")
        await until(evaluations, "a", EvaluationState.SUCCEEDED)
        monkeypatch.setattr(EvaluationStore, "delete", delete_behind)
        deleting = asyncio.create_task(evaluations.delete("a"))
        await gate.reached()
        for ask, kind in (
            (create(evaluations, "a"), ErrorKind.EVALUATION_EXISTS),
            (evaluations.get("a"), ErrorKind.UNKNOWN_EVALUATION),
            (evaluations.delete("a"), ErrorKind.UNKNOWN_EVALUATION),
        ):
            with pytest.raises(ServiceError) as caught:
                await ask
            assert caught.value.kind is kind
        gate.open()
        await deleting
        await create(evaluations, "a")


async def watched_while_it_runs(
    evaluations: Evaluations, identity: str
) -> AsyncIterator[EvaluationInfo]:
    """Creates an evaluation; what is told of it from its running on."""
    await create(evaluations, identity)
    await until(evaluations, identity, EvaluationState.RUNNING)
    watching = evaluations.watch(identity)
    assert (await anext(watching)).state is EvaluationState.RUNNING
    return watching


async def test_what_cannot_be_deleted_stays_and_goes_on(
    settings: Settings, carried: Callable[[Run], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    release = asyncio.Event()

    async def wait(folder: EvaluationFolder, note: Callable[[EvaluationProgress], object]) -> None:
        await release.wait()
        await at_once(folder, note)

    carried(wait)
    async with opened(settings) as evaluations:
        watching = await watched_while_it_runs(evaluations, "a")
        with monkeypatch.context() as patch:
            patch.setattr(EvaluationStore, "delete", full_disk)
            with pytest.raises(sqlite3.OperationalError):
                await evaluations.delete("a")
        release.set()
        async with asyncio.timeout(WAIT_S):
            states = [info.state async for info in watching]
        assert states[-1] is EvaluationState.SUCCEEDED
        await evaluations.delete("a")
        assert folders(settings) == []


async def test_who_watches_is_told_though_files_cannot_be_deleted(
    settings: Settings, carried: Callable[[Run], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(folder: EvaluationFolder) -> None:
        raise PermissionError(folder.path)

    carried(forever)
    async with opened(settings) as evaluations:
        watching = await watched_while_it_runs(evaluations, "a")
        with monkeypatch.context() as patch:
            patch.setattr(EvaluationFolder, "remove", refuse)
            with pytest.raises(PermissionError):
                await evaluations.delete("a")
        with pytest.raises(ServiceError) as caught:
            async with asyncio.timeout(WAIT_S):
                await anext(watching)
        assert caught.value.kind is ErrorKind.UNKNOWN_EVALUATION
        await create(evaluations, "b")
        assert folders(settings) == ["00000001", "00000002"]
    async with opened(settings):
        assert folders(settings) == ["00000002"]  # the files left behind are swept up


async def test_what_is_created_before_the_start_is_done_waits_for_what_is_kept(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    carried(at_once)
    async with opened(settings) as evaluations:
        await create(evaluations, "a")
    metrics = Metrics()
    evaluations = Evaluations(settings, metrics, WorkInHand(metrics))
    creating = asyncio.create_task(create(evaluations, "b"))
    await asyncio.sleep(0.05)
    await evaluations.start()
    try:
        await creating
        assert folders(settings) == ["00000001", "00000002"]
    finally:
        await evaluations.close()


async def test_no_more_are_kept_than_may_be(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    carried(at_once)
    async with opened(settings.model_copy(update={"max_evaluations": 1})) as evaluations:
        await create(evaluations, "a")
        await until(evaluations, "a", EvaluationState.SUCCEEDED)
        with pytest.raises(ServiceError) as caught:
            await create(evaluations, "b")
        assert caught.value.kind is ErrorKind.TOO_MANY_EVALUATIONS
        await evaluations.delete("a")
        await create(evaluations, "b")


async def test_draining_refuses_calls_and_ends_watches(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    carried(forever)
    async with opened(settings) as evaluations:
        await create(evaluations, "a")
        watching = asyncio.create_task(until(evaluations, "a", EvaluationState.SUCCEEDED))
        await until(evaluations, "a", EvaluationState.RUNNING)
        evaluations.begin_drain()
        for ask in (watching, evaluations.get("a"), create(evaluations, "b")):
            with pytest.raises(ServiceError) as caught:
                await ask
            assert caught.value.kind is ErrorKind.DRAINING


async def test_a_slow_reader_misses_what_is_superseded_but_never_the_end(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    carried(at_once)
    async with opened(settings) as evaluations:
        await create(evaluations, "a")
        watching = evaluations.watch("a")
        first = await anext(watching)
        assert not first.state.ended
        await until(evaluations, "a", EvaluationState.SUCCEEDED)
        assert [info.state async for info in watching] == [EvaluationState.SUCCEEDED]


async def test_metrics_count_evaluations_by_state(
    settings: Settings, carried: Callable[[Run], None]
) -> None:
    carried(at_once)
    async with opened(settings) as evaluations:
        await create(evaluations, "a")
        await until(evaluations, "a", EvaluationState.SUCCEEDED)
        text = evaluations._queue._metrics.render().decode()
    assert 'trajectron_evaluations{state="succeeded"} 1.0' in text
    assert 'trajectron_evaluations{state="running"} 0.0' in text
    assert 'trajectron_evaluation_duration_seconds_count{state="succeeded"} 1.0' in text


def test_the_sets_of_a_data_set_are_all_unless_named(settings: Settings) -> None:
    choices = EvaluationChoices(settings, {})
    every = EvaluationConfig(models=("constant-velocity",), dataset="eth_ucy")
    assert choices.resolve(every, ()).sets == ("street", "park")
    assert choices.resolve(ASKED, ()).sets == ("street",)
    plan = choices.plan(choices.resolve(ASKED, ()), ())
    assert (plan.entries, plan.sets, plan.files) == (("constant-velocity",), ("street",), ())
    assert (plan.protocol, plan.samples, plan.seed) == ("sgan", 100, 0)


def test_a_served_model_is_judged_by_its_own_files(settings: Settings, tmp_path: Path) -> None:
    mine = {"mine": tmp_path / "mine", "eth_ucy": tmp_path / "eth_ucy"}
    choices = EvaluationChoices(settings, mine)
    names = ("mine@z_best", "mine", "eth_ucy", "eth_ucy-without-eth@stratified")
    config = EvaluationConfig(models=names, dataset="eth_ucy")
    resolved = choices.resolve(config, ())
    # Paths, for a bundled model or a baseline of the same name would be taken instead.
    assert choices.plan(resolved, ()).entries == (
        "./mine@z_best", "./mine", "./eth_ucy", "eth_ucy-without-eth@stratified",
    )  # fmt: skip
    assert choices.model_files(resolved) == mine


@pytest.mark.parametrize("name", ["eth_ucy", "constant-velocity"])
def test_a_served_model_of_a_bundled_name_has_its_results_under_the_name_asked_for(
    settings: Settings,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    name: str,
) -> None:
    stem = save_small_model(tmp_path / name)
    choices = EvaluationChoices(settings, {name: stem})
    asked = EvaluationConfig(models=(name, "kalman"), num_samples=3, in_sample=True)
    file = RecordingFile("square.csv", walkers())
    config = choices.resolve(asked, (file,))
    folder = EvaluationFolder(tmp_path / "evaluation")
    plan = choices.plan(config, (file.name,)).to_json()
    folder.fill(plan, (file,), choices.model_files(config))
    monkeypatch.chdir(folder.work)
    assert worker.main(folder.run, None) == 0

    result = json.loads(folder.result(ResultFormat.JSON).content)
    assert [row["name"] for row in result["rows"]] == [name, "kalman"]
    assert result["rows"][0]["sets"][0]["model_sha256"] == registry.describe(stem).sha256
    assert result["fingerprint"]["plan"]["entries"] == [name, "kalman"]
    assert {(one["first"], one["second"]) for one in result["comparisons"]} == {(name, "kalman")}
    lines = folder.result(ResultFormat.CSV).content.decode().splitlines()[1:]
    assert {line.split(",")[0] for line in lines} == {name, "kalman"}
    assert f"./{name}".encode() not in folder.result(ResultFormat.HTML).content
    told_of = [
        json.loads(line)["progress"]["entry"] for line in capfd.readouterr().out.splitlines()
    ]
    assert set(told_of) <= {name, "kalman"} and told_of[0] == name


async def test_a_module_that_fails_leaves_its_reason_in_the_log(tmp_path: Path) -> None:
    background = Background("low", 1)
    async with background.process("missing", folder=tmp_path, log=tmp_path / "log") as process:
        assert [value async for value in told(process)] == []
        assert await process.wait() == 1
    assert "evaluations.missing" in (tmp_path / "log").read_text()


@pytest.mark.parametrize("let_go", [True, False])
async def test_a_process_beside_ends_with_the_service_and_with_its_block(
    tmp_path: Path, let_go: bool
) -> None:
    endless = tmp_path / "endless.csv"
    os.mkfifo(endless)  # reading it waits for a writer, who never comes
    background = Background("normal", 1)
    async with background.process("reading", "10", str(endless), folder=tmp_path) as process:
        assert process.stdin is not None
        if let_go:  # as when the service was killed
            process.stdin.close()
            assert await process.wait() == 1
    assert process.returncode == (1 if let_go else -signal.SIGTERM)


@pytest.mark.skipif(not hasattr(os, "SCHED_IDLE"), reason="priorities are those of Linux")
@pytest.mark.parametrize(("priority", "nice"), [("idle", 19), ("low", 19), ("normal", 0)])
async def test_a_process_beside_takes_its_priority(
    tmp_path: Path, priority: Priority, nice: int
) -> None:
    endless = tmp_path / "endless.csv"
    os.mkfifo(endless)
    expected = min(19, os.getpriority(os.PRIO_PROCESS, 0) + nice), priority == "idle"
    background = Background(priority, 1)
    async with background.process("reading", "10", str(endless), folder=tmp_path) as process:

        def taken() -> tuple[int, bool]:
            idle = os.sched_getscheduler(process.pid) == os.SCHED_IDLE
            return os.getpriority(os.PRIO_PROCESS, process.pid), idle

        async with asyncio.timeout(60):
            while taken() != expected:  # noqa: ASYNC110  it is another process that changes it
                await asyncio.sleep(0.01)


def test_the_last_words_of_a_process_are_its_reason(tmp_path: Path) -> None:
    folder = EvaluationFolder(tmp_path)
    assert folder.last_words() == ""
    folder.log.write_text("Traceback\n  line 3\nMemoryError: no more\n\n")
    assert folder.last_words() == "MemoryError: no more"
    folder.log.write_text(f"OSError: no space for '{folder.work}/b'\n")
    assert folder.last_words() == "OSError: no space for 'work/b'"
