"""HTTP's errors as the client's exceptions: the kind is in the problem's ``reason``."""

from __future__ import annotations

import json

import httpx

from trajectron_client.exceptions import (
    DeadlineExceededError,
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
        problem = json.loads(response.content)
        violations = tuple(
            Violation(v["field"], v["description"]) for v in problem.get("violations", ())
        )
        reason, detail = problem["reason"], problem["detail"]
    except (ValueError, KeyError, TypeError, AttributeError):
        return _foreign(response)
    return service_error(
        reason, detail, violations=violations, retry_after_s=_retry_after_s(response)
    )


def from_httpx(error: httpx.HTTPError) -> TrajectronError:
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
