"""What the client raises.

TrajectronError
├── TransportError                  no answer of the service: refused, broken off, not understood
├── SessionLostError                the service has lost frames that it had acknowledged
└── ServiceError                    the service answered with an error
    ├── InvalidArgumentError        a field of the request is at fault; see ``violations``
    │   └── MalformedError          the request could not be read at all
    ├── NotFoundError
    │   ├── UnknownSessionError     never opened, deleted, or idle for too long
    │   ├── UnknownEvaluationError  never created, or deleted
    │   ├── UnknownModelError
    │   └── UnknownAgentError
    ├── ConflictError
    │   ├── SessionExistsError
    │   ├── FrameConflictError      the newest frame's time with other content
    │   ├── FrameOutOfOrderError    earlier than the newest frame
    │   ├── NoFramesError           a forecast before the first frame
    │   ├── EvaluationExistsError
    │   ├── NoResultError           of an evaluation that has not succeeded
    │   └── DatasetUnavailableError
    ├── ResourceExhaustedError
    │   ├── TooManySessionsError
    │   ├── TooManyStreamsError     ``retry_after_s``
    │   ├── TooManyEvaluationsError
    │   ├── TooLargeError
    │   ├── RateLimitedError        the tenant's calls, frames or points a second; ``retry_after_s``
    │   └── OverloadedError         the queue is full; see ``retry_after_s``
    ├── UnauthenticatedError        a valid token is required
    ├── PermissionDeniedError       the token lacks the scope that the call needs
    ├── SessionDamagedError         what was stored of the session cannot be read any more
    ├── StoreUnavailableError       sessions cannot be stored now; ``retry_after_s``
    ├── DrainingError               the server is stopping; another replica may answer
    ├── DeadlineExceededError       no answer within ``timeout_s``
    ├── CancelledError
    └── InternalError
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Violation:
    """One field at fault: its path in the request, and what must hold of it."""

    field: str
    description: str


class TrajectronError(Exception):
    """The base of everything the client raises."""


class TransportError(TrajectronError):
    """No answer of the service: the connection was refused or broken, or the answer unreadable."""


class SessionLostError(TrajectronError):
    """A stream cannot go on: the service has lost frames of its session that it acknowledged."""


class ServiceError(TrajectronError):
    """The service answered with an error.

    Args:
        message: what was wrong, where, and what to do.
        reason: the service's name of the kind, such as ``"UNKNOWN_SESSION"``.
        violations: the fields at fault, for errors of the request.
        retry_after_s: seconds after which trying again is worth it; None when it is not.
    """

    def __init__(
        self,
        message: str,
        *,
        reason: str = "",
        violations: tuple[Violation, ...] = (),
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.reason = reason
        self.violations = violations
        self.retry_after_s = retry_after_s


class InvalidArgumentError(ServiceError):
    """A field of the request is at fault; ``violations`` names it."""


class MalformedError(InvalidArgumentError):
    """The request could not be read at all."""


class NotFoundError(ServiceError):
    """Something that the request names does not exist."""


class UnknownSessionError(NotFoundError):
    """The session was never opened, was deleted, or was idle for too long."""


class UnknownEvaluationError(NotFoundError):
    """The evaluation was never created, or was deleted."""


class UnknownModelError(NotFoundError):
    """The server does not run this model."""


class UnknownAgentError(NotFoundError):
    """The scene has no such agent."""


class ConflictError(ServiceError):
    """The request does not fit the state of what it is about."""


class SessionExistsError(ConflictError):
    """The id is taken."""


class FrameConflictError(ConflictError):
    """The frame has the time of the newest one, with other content."""


class FrameOutOfOrderError(ConflictError):
    """The frame is earlier than the newest one."""


class NoFramesError(ConflictError):
    """The session has seen no frame yet."""


class EvaluationExistsError(ConflictError):
    """The id is taken."""


class NoResultError(ConflictError):
    """The evaluation has not ended, or has not succeeded."""


class DatasetUnavailableError(ConflictError):
    """The server knows the data set but has not got it."""


class ResourceExhaustedError(ServiceError):
    """A limit of the server was reached."""


class TooManySessionsError(ResourceExhaustedError):
    """The server, or the tenant, holds as many sessions as it may."""


class TooManyStreamsError(ResourceExhaustedError):
    """The tenant has as many streams open as it may."""


class TooManyEvaluationsError(ResourceExhaustedError):
    """The server, or the tenant, keeps as many evaluations as it may; delete some."""


class TooLargeError(ResourceExhaustedError):
    """The request, or the answer to it, is larger than the server allows."""


class OverloadedError(ResourceExhaustedError):
    """The server's queue is full; ``retry_after_s`` says when to try again."""


class RateLimitedError(ResourceExhaustedError):
    """What the tenant may ask for a second is used up; ``retry_after_s`` says when to go on.

    Of calls, frames or points of forecasts: the message says which.
    """


class UnauthenticatedError(ServiceError):
    """A valid token is required: none was sent, or it is unknown or has expired."""


class PermissionDeniedError(ServiceError):
    """The token lacks the scope that the call needs."""


class SessionDamagedError(ServiceError):
    """What the service had stored of the session cannot be read; it is kept aside there."""


class StoreUnavailableError(ServiceError):
    """The service cannot store sessions now: what was sent may count or not; try it again."""


class DrainingError(ServiceError):
    """The server is stopping and takes no new work."""


class DeadlineExceededError(ServiceError):
    """No answer came within ``timeout_s``."""


class CancelledError(ServiceError):
    """The call was cancelled."""


class InternalError(ServiceError):
    """A fault of the server."""


BY_REASON: dict[str, type[ServiceError]] = {
    "INVALID_ARGUMENT": InvalidArgumentError,
    "MALFORMED": MalformedError,
    "UNKNOWN_SESSION": UnknownSessionError,
    "SESSION_DAMAGED": SessionDamagedError,
    "UNKNOWN_MODEL": UnknownModelError,
    "UNKNOWN_AGENT": UnknownAgentError,
    "SESSION_EXISTS": SessionExistsError,
    "FRAME_CONFLICT": FrameConflictError,
    "FRAME_OUT_OF_ORDER": FrameOutOfOrderError,
    "NO_FRAMES": NoFramesError,
    "UNKNOWN_EVALUATION": UnknownEvaluationError,
    "EVALUATION_EXISTS": EvaluationExistsError,
    "EVALUATION_HAS_NO_RESULT": NoResultError,
    "DATASET_UNAVAILABLE": DatasetUnavailableError,
    "TOO_MANY_EVALUATIONS": TooManyEvaluationsError,
    "TOO_MANY_SESSIONS": TooManySessionsError,
    "TOO_MANY_STREAMS": TooManyStreamsError,
    "TOO_LARGE": TooLargeError,
    "RATE_LIMITED": RateLimitedError,
    "UNAUTHENTICATED": UnauthenticatedError,
    "PERMISSION_DENIED": PermissionDeniedError,
    "OVERLOADED": OverloadedError,
    "DRAINING": DrainingError,
    "STORE_UNAVAILABLE": StoreUnavailableError,
    "DEADLINE_EXCEEDED": DeadlineExceededError,
    "CANCELLED": CancelledError,
    "INTERNAL": InternalError,
}


def service_error(
    reason: str,
    message: str,
    *,
    violations: tuple[Violation, ...] = (),
    retry_after_s: float | None = None,
) -> ServiceError:
    """The exception of a kind; a kind newer than this client is a plain ``ServiceError``."""
    kind = BY_REASON.get(reason, ServiceError)
    return kind(message, reason=reason, violations=violations, retry_after_s=retry_after_s)
