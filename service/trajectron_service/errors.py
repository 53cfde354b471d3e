"""The kinds of errors the service answers with, and their codes on both transports.

This is the only place that knows a code: adapters look a kind up in ``CODES``;
neither transport's code is derived from the other's.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

DOMAIN = "trajectron"


class ErrorKind(enum.Enum):
    """What went wrong; the value is ``ErrorInfo.reason`` and the problem type."""

    UNAUTHENTICATED = "UNAUTHENTICATED"
    PERMISSION_DENIED = "PERMISSION_DENIED"
    RATE_LIMITED = "RATE_LIMITED"
    INVALID_ARGUMENT = "INVALID_ARGUMENT"
    MALFORMED = "MALFORMED"
    UNKNOWN_SESSION = "UNKNOWN_SESSION"
    SESSION_DAMAGED = "SESSION_DAMAGED"
    UNKNOWN_MODEL = "UNKNOWN_MODEL"
    UNKNOWN_AGENT = "UNKNOWN_AGENT"
    SESSION_EXISTS = "SESSION_EXISTS"
    FRAME_CONFLICT = "FRAME_CONFLICT"
    FRAME_OUT_OF_ORDER = "FRAME_OUT_OF_ORDER"
    NO_FRAMES = "NO_FRAMES"
    UNKNOWN_EVALUATION = "UNKNOWN_EVALUATION"
    EVALUATION_EXISTS = "EVALUATION_EXISTS"
    EVALUATION_HAS_NO_RESULT = "EVALUATION_HAS_NO_RESULT"
    DATASET_UNAVAILABLE = "DATASET_UNAVAILABLE"
    TOO_MANY_EVALUATIONS = "TOO_MANY_EVALUATIONS"
    TOO_MANY_SESSIONS = "TOO_MANY_SESSIONS"
    TOO_MANY_STREAMS = "TOO_MANY_STREAMS"
    TOO_LARGE = "TOO_LARGE"
    OVERLOADED = "OVERLOADED"
    DRAINING = "DRAINING"
    STORE_UNAVAILABLE = "STORE_UNAVAILABLE"
    DEADLINE_EXCEEDED = "DEADLINE_EXCEEDED"
    CANCELLED = "CANCELLED"
    INTERNAL = "INTERNAL"


@dataclass(frozen=True)
class Codes:
    """The codes of one kind: a ``grpc.StatusCode`` name, an HTTP status, whether to try again."""

    grpc: str
    http: int
    retryable: bool = False


CODES: dict[ErrorKind, Codes] = {
    ErrorKind.UNAUTHENTICATED: Codes("UNAUTHENTICATED", 401),
    ErrorKind.PERMISSION_DENIED: Codes("PERMISSION_DENIED", 403),
    ErrorKind.RATE_LIMITED: Codes("RESOURCE_EXHAUSTED", 429, retryable=True),
    ErrorKind.INVALID_ARGUMENT: Codes("INVALID_ARGUMENT", 422),
    ErrorKind.MALFORMED: Codes("INVALID_ARGUMENT", 400),
    ErrorKind.UNKNOWN_SESSION: Codes("NOT_FOUND", 404),
    ErrorKind.SESSION_DAMAGED: Codes("DATA_LOSS", 410),
    ErrorKind.UNKNOWN_MODEL: Codes("NOT_FOUND", 404),
    ErrorKind.UNKNOWN_AGENT: Codes("NOT_FOUND", 404),
    ErrorKind.SESSION_EXISTS: Codes("ALREADY_EXISTS", 409),
    ErrorKind.FRAME_CONFLICT: Codes("FAILED_PRECONDITION", 409),
    ErrorKind.FRAME_OUT_OF_ORDER: Codes("FAILED_PRECONDITION", 409),
    ErrorKind.NO_FRAMES: Codes("FAILED_PRECONDITION", 409),
    ErrorKind.UNKNOWN_EVALUATION: Codes("NOT_FOUND", 404),
    ErrorKind.EVALUATION_EXISTS: Codes("ALREADY_EXISTS", 409),
    ErrorKind.EVALUATION_HAS_NO_RESULT: Codes("FAILED_PRECONDITION", 409),
    ErrorKind.DATASET_UNAVAILABLE: Codes("FAILED_PRECONDITION", 409),
    ErrorKind.TOO_MANY_EVALUATIONS: Codes("RESOURCE_EXHAUSTED", 429, retryable=True),
    ErrorKind.TOO_MANY_SESSIONS: Codes("RESOURCE_EXHAUSTED", 429, retryable=True),
    ErrorKind.TOO_MANY_STREAMS: Codes("RESOURCE_EXHAUSTED", 429, retryable=True),
    ErrorKind.TOO_LARGE: Codes("RESOURCE_EXHAUSTED", 413),
    ErrorKind.OVERLOADED: Codes("RESOURCE_EXHAUSTED", 429, retryable=True),
    ErrorKind.DRAINING: Codes("UNAVAILABLE", 503, retryable=True),
    ErrorKind.STORE_UNAVAILABLE: Codes("UNAVAILABLE", 503, retryable=True),
    ErrorKind.DEADLINE_EXCEEDED: Codes("DEADLINE_EXCEEDED", 504),
    ErrorKind.CANCELLED: Codes("CANCELLED", 499),
    ErrorKind.INTERNAL: Codes("INTERNAL", 500),
}


@dataclass(frozen=True)
class FieldViolation:
    """One field at fault: its path in the request, and what must hold of it."""

    field: str
    description: str


class ServiceError(Exception):
    """An error of a known kind, raised by the core and encoded by the adapters.

    Args:
        kind: what went wrong.
        message: what was wrong, where, and what to do.
        violations: the fields at fault, for errors of the request.
        retry_after_s: when a retry is worth it, for retryable kinds.
    """

    def __init__(
        self,
        kind: ErrorKind,
        message: str,
        *,
        violations: tuple[FieldViolation, ...] = (),
        retry_after_s: float | None = None,
    ) -> None:
        super().__init__(message)
        self.kind = kind
        self.message = message
        self.violations = violations
        self.retry_after_s = retry_after_s

    @property
    def codes(self) -> Codes:
        """The codes of this error's kind."""
        return CODES[self.kind]


def invalid(field: str, description: str) -> ServiceError:
    """An ``INVALID_ARGUMENT`` error that names one field."""
    return ServiceError(
        ErrorKind.INVALID_ARGUMENT,
        f"{field}: {description}",
        violations=(FieldViolation(field, description),),
    )
