"""Server-sent events of the HTTP API as the client's values."""

from __future__ import annotations

import json

import httpx
from httpx_sse import ServerSentEvent

from trajectron_client import evaluations, http_errors
from trajectron_client.evaluations import Evaluation

# The service says something every 15 s, if only that it is there.
_LONGEST_SILENCE_S = 60.0


def timeout(timeout_s: float | None, connect_s: float | None) -> httpx.Timeout:
    """How long connecting may take, and how long any silence may last."""
    return httpx.Timeout(connect_s, read=_LONGEST_SILENCE_S if timeout_s is None else timeout_s)


def evaluation(event: ServerSentEvent) -> Evaluation:
    """The evaluation that an event tells; raises the problem that it tells instead."""
    if event.event == "problem":
        raise http_errors.from_problem(json.loads(event.data), retry_after_s=None)
    return evaluations.from_body(json.loads(event.data))
