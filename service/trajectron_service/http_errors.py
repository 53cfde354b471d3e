"""Errors over HTTP: RFC 9457 ``application/problem+json``."""

from __future__ import annotations

import math
from http import HTTPStatus
from typing import Any

import orjson
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field, ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from trajectron_service.errors import ErrorKind, FieldViolation, ServiceError

PROBLEM_JSON = "application/problem+json"
_MOST_VIOLATIONS = 20
_TEXT_OF_TYPE = {
    "extra_forbidden": "unknown field; leave it out or correct its name",
    "missing": "is required",
}


class Violation(BaseModel):
    """One field at fault."""

    field: str = Field(description="Its path in the request, such as `frames[0].agents[3].x`.")
    description: str = Field(description="What must hold of it.")


class Problem(BaseModel):
    """An error, as RFC 9457 has it."""

    type: str = Field(description="A URI of the kind of error; `about:blank` for plain HTTP ones.")
    title: str = Field(description="The kind of error in words.")
    status: int = Field(description="The HTTP status.")
    detail: str = Field(description="What was wrong, where, and what to do.")
    reason: str = Field(description="The kind of error, as in gRPC's `ErrorInfo.reason`.")
    violations: list[Violation] = Field(description="The fields at fault, if any.")
    retryable: bool = Field(
        description="Whether the same request may succeed later; the header `Retry-After` then "
        "says in how many seconds."
    )


def problem_response(error: ServiceError) -> Response:
    """An error of the core as a problem; retryable ones carry ``Retry-After`` (whole seconds)."""
    headers = {}
    if error.kind is ErrorKind.TOO_LARGE:
        # What of the body is still on its way will not be read.
        headers["Connection"] = "close"
    if error.kind is ErrorKind.UNAUTHENTICATED:
        headers["WWW-Authenticate"] = 'Bearer realm="trajectron"'
    if error.codes.retryable:
        headers["Retry-After"] = str(max(1, math.ceil(error.retry_after_s or 1.0)))
    return _response(problem_of(error), headers)


def problem_of(error: ServiceError) -> Problem:
    """The body of ``problem_response``."""
    return Problem(
        type=f"urn:trajectron:problem:{error.kind.value}",
        title=error.kind.value.replace("_", " ").capitalize(),
        status=error.codes.http,
        detail=error.message,
        reason=error.kind.value,
        violations=[
            Violation(field=violation.field, description=violation.description)
            for violation in error.violations
        ],
        retryable=error.codes.retryable,
    )


def http_problem(error: HTTPException, path: str) -> Response:
    """An error of HTTP itself (no such path, wrong method) as a problem."""
    status = HTTPStatus(error.status_code)
    details = {
        HTTPStatus.NOT_FOUND: f"there is nothing at {path}; /docs lists every path",
        HTTPStatus.METHOD_NOT_ALLOWED: f"{path} has no such method; the header Allow names those "
        "that it has",
    }
    problem = Problem(
        type="about:blank",
        title=status.phrase,
        status=status,
        detail=details.get(status, str(error.detail)),
        reason=status.name,
        violations=[],
        retryable=False,
    )
    return _response(problem, dict(error.headers or {}))


def invalid_body(error: ValidationError) -> ServiceError:
    """What pydantic refused, as an error of the core's kinds: broken JSON or wrong fields."""
    faults = error.errors(include_url=False, include_input=False)
    if faults[0]["type"] == "json_invalid":
        reason = faults[0]["ctx"]["error"]
        return ServiceError(ErrorKind.MALFORMED, f"the body is not valid JSON: {reason}")
    return _invalid_fields([(fault["loc"], fault["type"], fault["msg"]) for fault in faults])


def invalid_parameters(error: RequestValidationError) -> ServiceError:
    """What fastapi refused of the path or query parameters."""
    return _invalid_fields(
        [(fault["loc"][1:], fault["type"], fault["msg"]) for fault in error.errors()]
    )


def _invalid_fields(faults: list[tuple[tuple[int | str, ...], str, str]]) -> ServiceError:
    violations = tuple(
        FieldViolation(_path(loc), _TEXT_OF_TYPE.get(kind, text[:1].lower() + text[1:]))
        for loc, kind, text in faults[:_MOST_VIOLATIONS]
    )
    first = violations[0]
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return ServiceError(
        ErrorKind.INVALID_ARGUMENT,
        f"{first.field or 'the body'}: {first.description}{more}",
        violations=violations,
    )


def _path(loc: tuple[int | str, ...]) -> str:
    path = ""
    for part in loc:
        path += f"[{part}]" if isinstance(part, int) else f".{part}" if path else part
    return path


async def on_service_error(_request: Request, error: Exception) -> Response:
    """Answers errors of the core."""
    assert isinstance(error, ServiceError)
    return problem_response(error)


async def on_http_exception(request: Request, error: Exception) -> Response:
    """Answers errors of HTTP itself."""
    assert isinstance(error, HTTPException)
    return http_problem(error, request.url.path)


async def on_invalid_parameters(_request: Request, error: Exception) -> Response:
    """Answers refused path and query parameters."""
    assert isinstance(error, RequestValidationError)
    return problem_response(invalid_parameters(error))


def _response(problem: Problem, headers: dict[str, Any]) -> Response:
    return Response(
        orjson.dumps(problem.model_dump()), problem.status, headers, media_type=PROBLEM_JSON
    )
