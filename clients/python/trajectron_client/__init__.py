"""The Python client of the prediction service: typed, synchronous and asyncio, no torch.

::

    from trajectron_client import Agent, Client, Frame

    with Client("127.0.0.1:50051") as client, client.session() as session:
        session.observe(Frame(0.0, [Agent("7", "pedestrian", 8.46, 3.59)]))
        session.observe(Frame(0.4, [Agent("7", "pedestrian", 9.02, 3.61)]))
        forecast = session.predict(mode="gmm", seed=7)
        walker = forecast["7"]
        walker.mean[walker.most_probable_mode]  # [H, 2] metres, at forecast.times

Positions are metres in your own world-fixed frame, times seconds on your own clock.
"""

from trajectron_client.access import Access
from trajectron_client.async_calls import AsyncSession
from trajectron_client.async_streams import AsyncStream
from trajectron_client.evaluations import (
    Evaluation,
    EvaluationOptions,
    EvaluationProgress,
    EvaluationState,
    RecordingFile,
)
from trajectron_client.exceptions import (
    CancelledError,
    ConflictError,
    DatasetUnavailableError,
    DeadlineExceededError,
    DrainingError,
    EvaluationExistsError,
    FrameConflictError,
    FrameOutOfOrderError,
    InternalError,
    InvalidArgumentError,
    MalformedError,
    NoFramesError,
    NoResultError,
    NotFoundError,
    OverloadedError,
    PermissionDeniedError,
    RateLimitedError,
    ResourceExhaustedError,
    ServiceError,
    SessionDamagedError,
    SessionExistsError,
    SessionLostError,
    StoreUnavailableError,
    TooLargeError,
    TooManyEvaluationsError,
    TooManySessionsError,
    TooManyStreamsError,
    TrajectronError,
    TransportError,
    UnauthenticatedError,
    UnknownAgentError,
    UnknownEvaluationError,
    UnknownModelError,
    UnknownSessionError,
    Violation,
)
from trajectron_client.forecast import AgentForecast, Forecast
from trajectron_client.grpc_client import AsyncClient, Client
from trajectron_client.http_client import AsyncHttpClient, HttpClient
from trajectron_client.replies import (
    FrameResult,
    GraphEdge,
    GraphNode,
    ModelInfo,
    Outcome,
    SceneGraph,
    SessionInfo,
    SessionSnapshot,
    StreamReply,
)
from trajectron_client.scene import (
    Agent,
    Delivery,
    ForecastMode,
    ForecastOptions,
    Frame,
    Sampling,
    SessionOptions,
    StreamFrame,
    UnknownTypes,
)
from trajectron_client.streams import Stream
from trajectron_client.sync_calls import Session

__all__ = [
    "Access",
    "Agent",
    "AgentForecast",
    "AsyncClient",
    "AsyncHttpClient",
    "AsyncSession",
    "AsyncStream",
    "CancelledError",
    "Client",
    "ConflictError",
    "DatasetUnavailableError",
    "DeadlineExceededError",
    "Delivery",
    "DrainingError",
    "Evaluation",
    "EvaluationExistsError",
    "EvaluationOptions",
    "EvaluationProgress",
    "EvaluationState",
    "Forecast",
    "ForecastMode",
    "ForecastOptions",
    "Frame",
    "FrameConflictError",
    "FrameOutOfOrderError",
    "FrameResult",
    "GraphEdge",
    "GraphNode",
    "HttpClient",
    "InternalError",
    "InvalidArgumentError",
    "MalformedError",
    "ModelInfo",
    "NoFramesError",
    "NoResultError",
    "NotFoundError",
    "Outcome",
    "OverloadedError",
    "PermissionDeniedError",
    "RateLimitedError",
    "RecordingFile",
    "ResourceExhaustedError",
    "Sampling",
    "SceneGraph",
    "ServiceError",
    "Session",
    "SessionDamagedError",
    "SessionExistsError",
    "SessionInfo",
    "SessionLostError",
    "SessionOptions",
    "SessionSnapshot",
    "StoreUnavailableError",
    "Stream",
    "StreamFrame",
    "StreamReply",
    "TooLargeError",
    "TooManyEvaluationsError",
    "TooManySessionsError",
    "TooManyStreamsError",
    "TrajectronError",
    "TransportError",
    "UnauthenticatedError",
    "UnknownAgentError",
    "UnknownEvaluationError",
    "UnknownModelError",
    "UnknownSessionError",
    "UnknownTypes",
    "Violation",
]
