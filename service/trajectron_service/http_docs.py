"""The OpenAPI description, and ``/docs``: Swagger UI from our own host, no other.

The page's script and style come from the package ``fastapi-offline``; a content security
policy holds the browser to this host.
"""

from __future__ import annotations

from importlib import resources
from typing import Any

import orjson
from fastapi import FastAPI
from fastapi.openapi.docs import get_swagger_ui_html
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema
from starlette.responses import RedirectResponse, Response
from starlette.staticfiles import StaticFiles

from trajectron_service.access import OPEN, scope_of_path
from trajectron_service.errors import ErrorKind, ServiceError, invalid
from trajectron_service.http_api import PROTOBUF
from trajectron_service.http_errors import PROBLEM_JSON, Problem, problem_of
from trajectron_service.http_evaluation_schemas import CreateEvaluationRequest
from trajectron_service.http_schemas import (
    CreateSessionRequest,
    ObserveRequest,
    PredictRequest,
    PredictSessionRequest,
)

_OPENAPI_PATH = "/openapi.json"
_ASSETS_PATH = "/docs/assets"
_REF = "#/components/schemas/{model}"
_BODIES: tuple[type[BaseModel], ...] = (
    PredictRequest,
    CreateSessionRequest,
    ObserveRequest,
    PredictSessionRequest,
    CreateEvaluationRequest,
    Problem,
)
_RETRY_AFTER = {
    "Retry-After": {
        "description": "Seconds until a retry is worth it.",
        "schema": {"type": "integer", "minimum": 1},
    }
}
_ERRORS: dict[int, str] = {
    400: "The body is not valid JSON.",
    401: "Where the service asks for tokens: there is none, or none in force.",
    403: "The token has not the scope that this call needs.",
    404: "No such session, evaluation, model or agent, as `reason` says.",
    409: "The state of the session or evaluation forbids it: `reason` is SESSION_EXISTS, "
    "FRAME_CONFLICT, FRAME_OUT_OF_ORDER, NO_FRAMES, EVALUATION_EXISTS, EVALUATION_HAS_NO_RESULT "
    "or DATASET_UNAVAILABLE.",
    410: "What is stored of the session cannot be read any more; it was set aside.",
    413: "The body is too large.",
    422: "A field is missing, mistyped, unknown or out of range: `violations` names it.",
    429: "The queue or the service is full; try again later.",
    500: "A fault of the service; its log has more under the answer's X-Request-Id.",
    503: "The service is starting or draining, or its store is away; try again, here or elsewhere.",
    504: "Not done before the deadline.",
}
_EXAMPLES: tuple[ServiceError, ...] = (
    ServiceError(
        ErrorKind.UNAUTHENTICATED, "a valid token is required: send `authorization: Bearer TOKEN`"
    ),
    ServiceError(
        ErrorKind.PERMISSION_DENIED, "this token has no scope evaluate, which the call needs"
    ),
    ServiceError(
        ErrorKind.MALFORMED, "the body is not valid JSON: expected value at line 1 column 1"
    ),
    ServiceError(
        ErrorKind.UNKNOWN_SESSION,
        'session_id: "crossing-4" is unknown: it was closed for want of use at '
        "2026-12-01T03:18:07+00:00 (600 s unused)",
    ),
    ServiceError(
        ErrorKind.SESSION_DAMAGED,
        'session_id: what is stored of "crossing-4" cannot be read (its checksum does not fit); '
        "it was set aside at 2026-12-01T03:18:07+00:00; open a new session",
    ),
    ServiceError(ErrorKind.SESSION_EXISTS, 'session_id: "crossing-4" is open already'),
    ServiceError(
        ErrorKind.TOO_LARGE,
        "the body is larger than 16777216 bytes; send less at a time",
    ),
    invalid("num_samples", "is 0; must be 1 to 2000"),
    ServiceError(
        ErrorKind.OVERLOADED, "the service is busy: too much work waits already; try again later"
    ),
    ServiceError(ErrorKind.INTERNAL, "a fault of the service; its log has more"),
    ServiceError(ErrorKind.DRAINING, "the service is stopping; another replica may answer"),
    ServiceError(ErrorKind.DEADLINE_EXCEEDED, "the deadline passed before the work was done"),
)
_EXAMPLE_OF_STATUS = {error.codes.http: problem_of(error).model_dump() for error in _EXAMPLES}
_INTRODUCTION = """
Watches scenes of moving agents and foretells the distribution of where each of them goes next.

**Units:** metres and seconds. Positions are in your own world-fixed, right-handed frame; nothing
is re-centred. **Forecasts** carry absolute positions here; with `Accept: application/x-protobuf`
the answer is the message of the gRPC API (`trajectron.v1`), whose arrays are offsets from each
agent's last position. **Errors** are RFC 9457 problems (`application/problem+json`).
"""


BINARY: dict[str, Any] = {"content": {PROTOBUF: {"schema": {"type": "string", "format": "binary"}}}}
"""An answer that can be had as the contract's message as well."""


def errors(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The descriptions of a route's error answers; every route can also answer 500."""
    return {
        status: {
            "description": _ERRORS[status],
            "content": {
                PROBLEM_JSON: {
                    "schema": {"$ref": _REF.format(model="Problem")},
                    "example": _EXAMPLE_OF_STATUS[status],
                }
            },
            **({"headers": _RETRY_AFTER} if status in (429, 503) else {}),
        }
        for status in (*statuses, 500)
    }


def takes(body: type[BaseModel], *, required: bool = True) -> dict[str, Any]:
    """The description of a route's body, which it reads itself (within a limit)."""
    schema = {"$ref": _REF.format(model=body.__name__)}
    content = {"application/json": {"schema": schema}}
    return {"requestBody": {"required": required, "content": content}}


def add_docs(app: FastAPI, version: str) -> None:
    """Adds ``/openapi.json`` and ``/docs``, which fastapi itself must not have been told to."""
    described: list[bytes] = []

    async def openapi() -> Response:
        if not described:
            described.append(orjson.dumps(_describe(app, version)))
        return Response(described[0], media_type="application/json")

    app.add_api_route(_OPENAPI_PATH, openapi, include_in_schema=False)
    static = resources.files("fastapi_offline") / "static"
    app.mount(_ASSETS_PATH, StaticFiles(directory=str(static)))
    app.add_api_route("/docs", _page, include_in_schema=False)
    app.add_api_route("/", _to_docs, include_in_schema=False)


def _describe(app: FastAPI, version: str) -> dict[str, Any]:
    description = get_openapi(
        title="Trajectron", version=version, description=_INTRODUCTION, routes=app.routes
    )
    _, definitions = models_json_schema(
        [(body, "validation") for body in _BODIES], ref_template=_REF
    )
    schemas = description.setdefault("components", {}).setdefault("schemas", {})
    for name, schema in definitions["$defs"].items():
        schemas.setdefault(name, schema)
    _describe_access(description)
    return description


def _describe_access(description: dict[str, Any]) -> None:
    """Adds the token, and the refusals for want of one, to every call that may need it."""
    description["components"]["securitySchemes"] = {
        "token": {
            "type": "http",
            "scheme": "bearer",
            "description": "From `trajectron token new`. Needed where the operator set `tokens`.",
        }
    }
    refusals = {str(status): answer for status, answer in errors(401, 403, 429).items()}
    for path, calls in description["paths"].items():
        scope = scope_of_path(path)
        if scope is OPEN:
            continue
        for call in calls.values():
            call["security"] = [{"token": []}, {}]
            call["description"] = f"{call.get('description', '')}\n\nScope: `{scope.value}`."
            for status, answer in refusals.items():
                call["responses"].setdefault(status, answer)


async def _page() -> Response:
    page = get_swagger_ui_html(
        openapi_url=_OPENAPI_PATH,
        title="Trajectron",
        swagger_js_url=f"{_ASSETS_PATH}/swagger-ui-bundle.js",
        swagger_css_url=f"{_ASSETS_PATH}/swagger-ui.css",
        swagger_favicon_url="data:,",
        # The default validator is a foreign host.
        swagger_ui_parameters={"validatorUrl": None},
    )
    page.headers["Content-Security-Policy"] = (
        "default-src 'self'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data:"
    )
    return page


async def _to_docs() -> Response:
    return RedirectResponse("/docs")
