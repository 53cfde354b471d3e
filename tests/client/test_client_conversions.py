"""What the service sends is what the caller gets, and the other way round, on both transports."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from datetime import UTC, datetime

import numpy as np
import orjson
import pytest

import trajectron_client as tc
from trajectron_client import json_bodies, operations, protobuf
from trajectron_proto.v1 import trajectron_pb2 as pb
from trajectron_service import grpc_convert, http_encode, http_schemas
from trajectron_service import messages as core

Z, H, S = 3, 4, 5


def forecast(*, samples: bool = True, modes: bool = True, x: float = 8.25) -> core.Forecast:
    rng = np.random.default_rng(7)

    def draw(*shape: int) -> core.Float32:
        return rng.normal(size=shape).astype(np.float32)

    agent = core.AgentForecast(
        id="7",
        type="pedestrian",
        x=x,
        y=-3.5,
        last_observed_time=9.6,
        observations=4,
        heading_known=True,
        mode_probabilities=np.array([0.25, 0.5, 0.25], dtype=np.float32),
        mean=draw(Z, H, 2) if modes else None,
        covariance=draw(Z, H, 3) if modes else None,
        samples=draw(S, H, 2) if samples else None,
        sample_modes=np.array([0, 1, 1, 2, 1]) if samples else None,
    )
    return core.Forecast(
        model="eth-ucy",
        model_hash="ab" * 32,
        mode=core.ForecastMode.FULL,
        seed=2**63 - 1,
        reference_time=10.0,
        time_offsets_s=(0.4, 0.8, 1.2, 1.6),
        agents=(agent,),
    )


def over_grpc(value: core.Forecast) -> tc.Forecast:
    wire = pb.PredictResponse(forecast=grpc_convert.forecast_message(value)).SerializeToString()
    return operations.predict_session("s", {}).from_message(pb.PredictResponse.FromString(wire))


def over_http(value: core.Forecast) -> tc.Forecast:
    wire = orjson.dumps(http_encode.forecast_json(value), option=orjson.OPT_SERIALIZE_NUMPY)
    return operations.predict_session("s", {}).from_body(orjson.loads(wire))


Carrier = Callable[[core.Forecast], tc.Forecast]
CARRIERS = pytest.mark.parametrize("carry", [over_grpc, over_http])


@CARRIERS
def test_a_forecast_says_that_its_samples_are_stratified(carry: Carrier) -> None:
    stratified = dataclasses.replace(forecast(), sampling=core.Sampling.STRATIFIED)
    assert carry(stratified).sample_semantics == "independent_agents_stratified"


@CARRIERS
def test_a_forecast_says_that_its_samples_are_fewer_than_asked_for(carry: Carrier) -> None:
    assert not carry(forecast()).fewer_samples
    got = carry(dataclasses.replace(forecast(), num_samples=7, fewer_samples=True))
    assert (got.num_samples, got.fewer_samples) == (7, True)


def test_a_deadline_and_fewer_samples_are_asked_for_alike() -> None:
    message = protobuf.forecast_options(deadline_s=0.25, allow_fewer_samples=True)
    assert message.deadline.ToMilliseconds() == 250
    assert message.allow_fewer_samples
    body = json_bodies.forecast_options(deadline_s=0.25, allow_fewer_samples=True)
    assert body == {"deadline_s": 0.25, "allow_fewer_samples": True}


@CARRIERS
def test_a_forecast_arrives_whole_and_in_absolute_positions(carry: Carrier) -> None:
    sent = forecast()
    got = carry(sent)
    assert (got.model, got.model_hash, got.mode, got.seed) == (
        "eth-ucy",
        "ab" * 32,
        "full",
        2**63 - 1,
    )
    assert got.sample_semantics == "independent_agents"
    assert got.mode_probability_floor == sent.mode_probability_floor == 0.0
    analytic = dataclasses.replace(sent, mode=core.ForecastMode.GMM)
    assert carry(analytic).mode_probability_floor == analytic.mode_probability_floor > 0.0
    np.testing.assert_allclose(got.times, [10.4, 10.8, 11.2, 11.6])
    agent, source = got["7"], sent.agents[0]
    assert agent.last_observed_time == 9.6
    assert (agent.type, agent.observations, agent.heading_known) == ("pedestrian", 4, True)
    assert agent.position.tolist() == [8.25, -3.5]
    assert source.mean is not None
    assert source.samples is not None
    assert source.covariance is not None
    assert agent.mean is not None
    assert agent.samples is not None
    assert agent.covariance is not None
    assert agent.sample_modes is not None
    assert agent.mean.dtype == agent.samples.dtype == agent.covariance.dtype == np.float64
    np.testing.assert_allclose(agent.mean, source.mean + agent.position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(agent.samples, source.samples + agent.position, rtol=0, atol=1e-12)
    assert agent.sample_modes.tolist() == [0, 1, 1, 2, 1]
    xx, xy, yy = np.moveaxis(source.covariance, -1, 0)
    np.testing.assert_allclose(agent.covariance[..., 0, 0], xx, rtol=1e-6)
    np.testing.assert_allclose(agent.covariance[..., 0, 1], xy, rtol=1e-6)
    np.testing.assert_allclose(agent.covariance[..., 1, 0], xy, rtol=1e-6)
    np.testing.assert_allclose(agent.covariance[..., 1, 1], yy, rtol=1e-6)


@CARRIERS
def test_a_million_metres_from_the_origin_nothing_is_lost(carry: Carrier) -> None:
    near, far = carry(forecast(x=0.0)), carry(forecast(x=1e6))
    assert near["7"].samples is not None
    assert far["7"].samples is not None
    np.testing.assert_allclose(
        far["7"].samples - far["7"].position, near["7"].samples - near["7"].position, atol=1e-9
    )


@CARRIERS
def test_what_was_not_asked_for_is_none(carry: Carrier) -> None:
    got = carry(forecast(samples=False, modes=False))
    agent = got["7"]
    arrays = (agent.samples, agent.sample_modes, agent.mean, agent.covariance)
    assert arrays == (None, None, None, None)
    with pytest.raises(ValueError, match="include_modes"):
        agent.mixture_mean()


def test_a_forecast_is_a_collection_of_its_agents() -> None:
    got = over_grpc(forecast())
    assert "7" in got
    assert "8" not in got
    assert len(got) == 1
    assert [agent.id for agent in got] == ["7"]
    with pytest.raises(KeyError):
        got["8"]


def test_mixture_moments_by_hand() -> None:
    # Two modes at 0 and 4 on the x axis, weights 3/4 and 1/4, each with unit covariance:
    # mean 1, variance along x 1 + (3/4 * 1 + 1/4 * 9) = 4, along y 1.
    agent = tc.AgentForecast(
        id="1",
        type="pedestrian",
        position=np.zeros(2),
        last_observed_time=0.0,
        observations=2,
        heading_known=True,
        mode_probabilities=np.array([0.75, 0.25]),
        mean=np.array([[[0.0, 0.0]], [[4.0, 0.0]]]),
        covariance=np.broadcast_to(np.eye(2), (2, 1, 2, 2)),
        samples=None,
        sample_modes=None,
    )
    assert agent.most_probable_mode == 0
    np.testing.assert_allclose(agent.mixture_mean(), [[1.0, 0.0]])
    np.testing.assert_allclose(agent.mixture_covariance(), [[[4.0, 0.0], [0.0, 1.0]]])


FRAMES = (
    tc.Frame(0.0, [tc.Agent("7", "pedestrian", 8.46, 3.59)]),
    tc.Frame(0.4, [tc.Agent("7", "pedestrian", 9.02, 3.61), tc.Agent("8", "dog", -1e6, 0.0)]),
    tc.Frame(0.8),
)
CORE_FRAMES = (
    core.Frame(0.0, (core.Agent("7", "pedestrian", 8.46, 3.59),)),
    core.Frame(
        0.4,
        (core.Agent("7", "pedestrian", 9.02, 3.61), core.Agent("8", "dog", -1e6, 0.0)),
    ),
    core.Frame(0.8, ()),
)


def test_the_service_reads_the_same_request_on_both_transports() -> None:
    options: tc.ForecastOptions = {
        "mode": "z_best",
        "num_samples": 3,
        "horizon": 7,
        "seed": 5,
        "agents": ["7"],
        "include_modes": True,
        "sampling": "stratified",
    }
    expected = core.ForecastOptions(
        core.ForecastMode.Z_BEST, 3, 7, 5, ("7",), True, core.Sampling.STRATIFIED
    )
    operation = operations.predict(
        FRAMES,
        model="zara1",
        unknown_types="map",
        type_map={"dog": "pedestrian"},
        frame_interval_s=0.1,
        options=options,
    )
    message = pb.PredictRequest.FromString(operation.message().SerializeToString())
    assert grpc_convert.frames(message.frames) == CORE_FRAMES
    assert grpc_convert.forecast_options(message.options) == expected
    assert grpc_convert.unknown_types(message.unknown_types) is core.UnknownTypes.MAP
    assert grpc_convert.seconds(message.frame_interval) == pytest.approx(0.1, abs=1e-12)
    assert (message.model, dict(message.type_map)) == ("zara1", {"dog": "pedestrian"})

    body = http_schemas.PredictRequest.model_validate_json(orjson.dumps(operation.body()))
    assert body.to_frames() == CORE_FRAMES
    assert body.to_options() == expected
    assert body.unknown_types is core.UnknownTypes.MAP
    assert (body.model, body.type_map, body.frame_interval_s) == (
        "zara1",
        {"dog": "pedestrian"},
        0.1,
    )


def test_what_is_left_out_is_left_to_the_server_on_both_transports() -> None:
    operation = operations.predict(
        FRAMES,
        model=None,
        unknown_types="reject",
        type_map=None,
        frame_interval_s=None,
        options={},
    )
    message = operation.message()
    assert isinstance(message, pb.PredictRequest)
    assert grpc_convert.forecast_options(message.options) == core.ForecastOptions()
    assert not message.HasField("frame_interval")
    body = http_schemas.PredictRequest.model_validate_json(orjson.dumps(operation.body()))
    assert body.to_options() == core.ForecastOptions()
    assert (body.model, body.frame_interval_s) == (None, None)


def test_a_session_is_configured_alike_on_both_transports() -> None:
    options: tc.SessionOptions = {
        "model": "zara1",
        "frame_interval_s": 0.2,
        "agent_timeout_s": 3.0,
        "idle_timeout_s": 60.0,
        "unknown_types": "ignore",
        "type_map": {"dog": "pedestrian"},
    }
    expected = core.SessionConfig(
        "zara1", 0.2, 3.0, 60.0, core.UnknownTypes.IGNORE, {"dog": "pedestrian"}
    )
    operation = operations.create_session("crossing-4", options)
    message = operation.message()
    assert isinstance(message, pb.CreateSessionRequest)
    assert message.session_id == "crossing-4"
    assert grpc_convert.session_config(message.config) == expected
    body = http_schemas.CreateSessionRequest.model_validate_json(orjson.dumps(operation.body()))
    assert (body.session_id, body.to_config()) == ("crossing-4", expected)


def test_sessions_graphs_results_and_models_arrive_alike_on_both_transports() -> None:
    config = core.SessionConfig(
        "zara1", 0.4, 3.0, 60.0, core.UnknownTypes.MAP, {"dog": "pedestrian"}
    )
    created = datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC)
    info = core.SessionInfo(
        "s", config, 0.4, 3, created.timestamp(), created.timestamp() + 60, 1.25, 2, 9
    )
    graph = core.SceneGraph(
        (core.GraphNode("a", "pedestrian", 1.5, 2.5, 4, 1.25),),
        (core.GraphEdge("a", "b", 3, 1, 0.75),),
    )
    operation = operations.get_session("s")
    message = pb.GetSessionResponse(
        session=grpc_convert.session_message(info), graph=grpc_convert.graph_message(graph)
    )
    json_body = http_encode.session_json(info) | {"graph": http_encode.graph_json(graph)}
    snapshot = operation.from_message(message)
    assert snapshot == operation.from_body(orjson.loads(orjson.dumps(json_body)))
    assert snapshot.info.created_at == created
    assert (snapshot.info.last_sequence, snapshot.info.last_frame_time) == (9, 1.25)
    assert snapshot.graph.edges == (tc.GraphEdge("a", "b", 3, 1, 0.75),)

    result = core.FrameResult(core.Outcome.ACCEPTED_WITH_GAPS, 4, ("a",), ("dog",), "", "")
    observe = operations.observe("s", FRAMES)
    results = observe.from_message(
        pb.ObserveResponse(results=[grpc_convert.result_message(result)])
    )
    encoded = orjson.loads(orjson.dumps({"results": [http_encode.result_json(result)]}))
    assert results == observe.from_body(encoded)
    assert results[0].outcome is tc.Outcome.ACCEPTED_WITH_GAPS
    assert not results[0].refused

    model = core.ModelInfo(
        "zara1", "ff", ("pedestrian",), 0.4, 12, 25, True, {"seed": 3}, "x86-64-v3"
    )
    models = operations.list_models()
    got = models.from_message(pb.ListModelsResponse(models=[grpc_convert.model_message(model)]))
    assert got == models.from_body(
        orjson.loads(orjson.dumps({"models": [http_encode.model_json(model)]}))
    )
    assert (got[0].provenance, got[0].kernels) == ({"seed": 3}, "x86-64-v3")


def test_frames_from_arrays() -> None:
    frame = tc.Frame.from_arrays(1.5, [3, "b"], np.array([[0.0, 1.0], [2.0, 3.0]], np.float32))
    assert frame == tc.Frame(
        1.5, (tc.Agent("3", "pedestrian", 0.0, 1.0), tc.Agent("b", "pedestrian", 2.0, 3.0))
    )
    assert tc.Frame.from_arrays(0.0, [], []).agents == ()
    mixed = tc.Frame.from_arrays(0.0, "ab", [[0, 0], [1, 1]], types=["vehicle", "cyclist"])
    assert [agent.type for agent in mixed.agents] == ["vehicle", "cyclist"]
    with pytest.raises(ValueError, match="2 ids, 1 positions and 2 types"):
        tc.Frame.from_arrays(0.0, "ab", [[0, 0]])


def test_a_misspelt_option_is_refused_as_python_refuses_it() -> None:
    client = tc.HttpClient("http://nowhere.invalid")
    with pytest.raises(TypeError, match="num_sample"):
        client.predict(FRAMES, num_sample=3)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="agent_timeout"):
        client.create_session(agent_timeout=3.0)  # type: ignore[call-arg]
    client.close()
