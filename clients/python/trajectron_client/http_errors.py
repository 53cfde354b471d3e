"""HTTP's errors as the client's exceptions: the kind is in the problem's ``reason``."""

from __future__ import annotations

import json
from typing import Any

import httpx

from trajectron_client.exceptions import (
    DeadlineExceededError,
    ServiceError,
    TrajectronError,
    TransportError,
    Violation,
    service_error,
)


def from_response(response: httpx.Response) -> TrajectronError:
    """The exception for an answer that is no success: RFC 9457 ``application/problem+json``."""
    if not response.headers.get("content-type", "").startswith("application/problem+json"):
        return _foreign(response)
    try:
        return from_problem(json.loads(response.content), _retry_after_s(response))
    except (ValueError, KeyError, TypeError, AttributeError):
        return _foreign(response)


def from_problem(problem: dict[str, Any], retry_after_s: float | None) -> ServiceError:
    """The exception for a problem of the service; raises KeyError or TypeError for another."""
    violations = tuple(
        Violation(v["field"], v["description"]) for v in problem.get("violations", ())
    )
    return service_error(
        problem["reason"], problem["detail"], violations=violations, retry_after_s=retry_after_s
    )


def from_httpx(error: Exception) -> TrajectronError:
    """The exception for a call that got no answer."""
    kind = type(error).__name__
    if isinstance(error, httpx.TimeoutException):
        return DeadlineExceededError(f"{kind}: {error}", reason="DEADLINE_EXCEEDED")
    return TransportError(f"{kind}: {error}")


def _foreign(response: httpx.Response) -> TransportError:
    """Something between us and the service has answered."""
    return TransportError(
        f"HTTP {response.status_code} {response.reason_phrase} from {response.url}: "
        f"not an answer of the service: {response.text[:200]!r}"
    )


def _retry_after_s(response: httpx.Response) -> float | None:
    """``Retry-After`` in seconds; a date, which the service does not send, counts as absent."""
    value = response.headers.get("retry-after", "")
    return float(value) if value.isdecimal() else None
