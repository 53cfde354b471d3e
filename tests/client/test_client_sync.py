"""The synchronous clients against the real service, both transports alike."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
import pytest
from tests.client.crowd import frame, walking
from tests.process import Served

import trajectron_client as tc
from trajectron_client.sync_calls import SyncCalls


@pytest.fixture(params=["grpc", "http"])
def client(request: pytest.FixtureRequest, served: Served) -> Iterator[SyncCalls]:
    if request.param == "grpc":
        with tc.Client(served.grpc_target, timeout_s=30.0) as over_grpc:
            yield over_grpc
    else:
        with tc.HttpClient(served.http_url, timeout_s=30.0) as over_http:
            yield over_http


def test_a_history_gives_futures(client: SyncCalls) -> None:
    forecast = client.predict(
        walking(), num_samples=5, horizon=6, seed=7, agents=["2", "0"], include_modes=True
    )
    assert [agent.id for agent in forecast] == ["2", "0"]
    assert forecast.seed == 7
    assert forecast.model == "small"
    np.testing.assert_allclose(forecast.times, 1.2 + 0.4 * np.arange(1, 7))
    agent = forecast["2"]
    assert agent.position.tolist() == [1.5, 2.0]
    assert agent.samples is not None
    assert agent.samples.shape == (5, 6, 2)
    assert agent.mean is not None
    assert agent.covariance is not None
    assert agent.covariance.shape == (*agent.mean.shape, 2)
    assert np.linalg.eigvalsh(agent.covariance).min() > 0
    assert agent.mode_probabilities.sum() == pytest.approx(1.0, abs=1e-5)
    assert agent.mixture_mean().shape == (6, 2)


def test_both_transports_give_the_same_futures(served: Served) -> None:
    with tc.Client(served.grpc_target) as one, tc.HttpClient(served.http_url) as other:
        first = one.predict(walking(), num_samples=4, seed=3, include_modes=True)
        second = other.predict(walking(), num_samples=4, seed=3, include_modes=True)
    for agent in first:
        twin = second[agent.id]
        assert agent.samples is not None
        assert twin.samples is not None
        assert agent.covariance is not None
        assert twin.covariance is not None
        np.testing.assert_allclose(agent.samples, twin.samples, atol=1e-4)
        np.testing.assert_allclose(agent.covariance, twin.covariance, atol=1e-4)


def test_samples_are_stratified_when_asked_for(client: SyncCalls) -> None:
    options: tc.ForecastOptions = {"num_samples": 50, "seed": 3, "sampling": "stratified"}
    with client.session() as session:
        session.observe_all([frame(0), frame(1)])
        forecast = session.predict(**options)
        again = session.predict(**options)
    assert forecast.sample_semantics == "independent_agents_stratified"
    for agent in forecast:
        assert agent.samples is not None and agent.sample_modes is not None
        np.testing.assert_array_equal(agent.samples, again[agent.id].samples)
        drawn = np.bincount(agent.sample_modes, minlength=agent.mode_probabilities.size)
        assert np.abs(drawn - 50 * agent.mode_probabilities).max() < 1.001


def test_a_session_lives_for_its_block(client: SyncCalls) -> None:
    with client.session(agent_timeout_s=3.0) as session:
        for step in range(3):
            result = session.observe(frame(step))
            assert (result.outcome, result.version) == (tc.Outcome.ACCEPTED, step + 1)
        results = session.observe_all([frame(3), frame(1), frame(4)])
        assert [r.outcome for r in results] == [
            tc.Outcome.ACCEPTED,
            tc.Outcome.OUT_OF_ORDER,
            tc.Outcome.ACCEPTED,
        ]
        assert results[1].refused
        forecast = session.predict(mode="gmm")
        assert forecast.reference_time == pytest.approx(1.6)
        assert forecast["0"].samples is None
        assert forecast["0"].mean is not None
        snapshot = session.describe()
        assert snapshot.info.version == 5
        assert snapshot.info.agent_timeout_s == 3.0
        assert snapshot.info.last_frame_time == pytest.approx(1.6)
        assert snapshot.info.expires_at > snapshot.info.created_at
        assert {node.id for node in snapshot.graph.nodes} == {"0", "1", "2"}
        assert {e.modulation for e in snapshot.graph.edges} == {1.0}
    with pytest.raises(tc.UnknownSessionError):
        client.get_session(session.id)


def test_a_block_that_fails_deletes_its_session_and_tells_its_own_error(
    client: SyncCalls,
) -> None:
    opened = []

    def fail() -> None:
        with client.session() as session:
            opened.append(session.id)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    with pytest.raises(tc.UnknownSessionError):
        client.get_session(opened[0])


def test_a_session_deleted_in_its_block_is_no_error(client: SyncCalls) -> None:
    with client.session() as session:
        session.delete()


def test_sessions_outlive_handles_that_are_attached(client: SyncCalls) -> None:
    name = f"kept-{type(client).__name__}"
    info = client.create_session(name)
    assert (info.id, info.version, info.last_frame_time, info.last_sequence) == (
        name,
        0,
        None,
        None,
    )
    client.attach(name).observe(frame(0))
    assert client.attach(name).describe().info.version == 1
    with pytest.raises(tc.SessionExistsError):
        client.create_session(name)
    client.delete_session(name)


def test_lists_run_over_pages(client: SyncCalls) -> None:
    names = [f"page-{type(client).__name__}-{n}" for n in range(5)]
    for name in names:
        client.create_session(name)
    assert [s.id for s in client.list_sessions(page_size=2) if s.id in names] == names
    for name in names:
        client.delete_session(name)


def test_errors_come_as_their_own_classes(client: SyncCalls) -> None:
    with pytest.raises(tc.InvalidArgumentError) as invalid:
        client.predict([tc.Frame(0.0, [tc.Agent("1", "pedestrian", 0.0, 1e300)])])
    assert invalid.value.violations[0].field.startswith("frames[0].agents[0]")
    with pytest.raises(tc.UnknownModelError):
        client.predict(walking(), model="no-such-model")
    with pytest.raises(tc.UnknownAgentError):
        client.predict(walking(), agents=["nobody"])
    with client.session() as session:
        with pytest.raises(tc.NoFramesError):
            session.predict()
        session.observe(frame(3))
        with pytest.raises(tc.FrameOutOfOrderError):
            session.observe(frame(2))
        with pytest.raises(tc.FrameConflictError):
            session.observe(frame(3, people=1))
        assert session.observe(frame(3)).outcome is tc.Outcome.DUPLICATE


def test_what_is_not_a_number_is_refused_alike(client: SyncCalls) -> None:
    with pytest.raises(tc.InvalidArgumentError) as invalid:
        client.predict([tc.Frame(0.0, [tc.Agent("1", "pedestrian", float("nan"), 0.0)])])
    assert [v.field for v in invalid.value.violations] == ["frames[0].agents[0].x"]


def test_models_and_readiness(client: SyncCalls) -> None:
    client.wait_until_ready(10.0)
    assert client.is_ready()
    (model,) = client.list_models()
    assert (model.name, model.agent_types, model.is_default) == ("small", ("pedestrian",), True)
    assert model.provenance["seed"] == 0


def test_a_deadline_that_cannot_be_met(client: SyncCalls) -> None:
    with pytest.raises(tc.DeadlineExceededError):
        client.predict(walking(), num_samples=2000, horizon=60, timeout_s=0.001)


def test_where_nobody_answers() -> None:
    with socket.socket() as taken:  # bound, but nobody listens
        taken.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{taken.getsockname()[1]}"
        with tc.Client(place) as client, tc.HttpClient(f"http://{place}") as http:
            for one in (client, http):
                assert not one.is_ready()
                with pytest.raises(tc.TransportError):
                    one.list_models()
                with pytest.raises(tc.DeadlineExceededError):
                    one.wait_until_ready(0.3)
