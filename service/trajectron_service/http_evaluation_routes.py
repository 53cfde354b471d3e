"""Which path leads where, for evaluations."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from starlette.responses import Response

from trajectron_service import http_evaluation_schemas as schemas
from trajectron_service.http_docs import BINARY, errors, takes
from trajectron_service.http_evaluations import HttpEvaluations
from trajectron_service.http_forms import FILES, MULTIPART

_ONE = "/v1/evaluations/{evaluation_id}"


def evaluation_routes(api: HttpEvaluations) -> APIRouter:
    """The routes of evaluations."""
    router = APIRouter(tags=["evaluations"])
    router.add_api_route(
        "/v1/evaluations",
        api.create,
        methods=["POST"],
        status_code=201,
        summary="Create an evaluation",
        operation_id="create_evaluation",
        response_model=schemas.Evaluation,
        responses={201: BINARY, **errors(400, 404, 409, 413, 422, 429, 503, 504)},
        openapi_extra=_takes_files(),
    )
    router.add_api_route(
        "/v1/evaluations",
        api.list_page,
        methods=["GET"],
        summary="List evaluations",
        operation_id="list_evaluations",
        response_model=schemas.Evaluations,
        responses={200: BINARY, **errors(422, 503)},
    )
    router.add_api_route(
        f"{_ONE}:watch",
        api.watch,
        methods=["GET"],
        summary="Watch an evaluation",
        operation_id="watch_evaluation",
        # Not fastapi's own class for events: it would take the endpoint for a generator.
        response_class=Response,
        responses={
            200: {"content": {"text/event-stream": {}}, "description": "Events `evaluation`."},
            **errors(404, 422, 503),
        },
    )
    router.add_api_route(
        f"{_ONE}:cancel",
        api.cancel,
        methods=["POST"],
        summary="Cancel an evaluation",
        operation_id="cancel_evaluation",
        response_model=schemas.Evaluation,
        responses={200: BINARY, **errors(404, 422, 503)},
    )
    _add_results(router, api)
    # Last: its path would take the others' for ids.
    router.add_api_route(
        _ONE,
        api.get,
        methods=["GET"],
        summary="Get an evaluation",
        operation_id="get_evaluation",
        response_model=schemas.Evaluation,
        responses={200: BINARY, **errors(404, 422, 503)},
    )
    router.add_api_route(
        _ONE,
        api.delete,
        methods=["DELETE"],
        status_code=204,
        summary="Delete an evaluation",
        operation_id="delete_evaluation",
        responses=errors(404, 422, 503),
    )
    return router


def _add_results(router: APIRouter, api: HttpEvaluations) -> None:
    for name, endpoint, content_type, summary in (
        ("result.json", api.result_json, "application/json", "Get a result"),
        ("result.csv", api.result_csv, "text/csv", "Get a result as CSV"),
        ("report.html", api.report, "text/html", "Get a result as a report"),
    ):
        router.add_api_route(
            f"{_ONE}/{name}",
            endpoint,
            methods=["GET"],
            summary=summary,
            operation_id=f"get_evaluation_{name.replace('.', '_')}",
            response_class=Response,
            responses={
                200: {"content": {content_type: {}}, "description": "The result."},
                **errors(404, 409, 422, 503),
            },
        )


def _takes_files() -> dict[str, Any]:
    """The description of a body that is JSON, or a form with JSON and files."""
    description = takes(schemas.CreateEvaluationRequest)
    content = description["requestBody"]["content"]
    file = {"type": "string", "format": "binary"}
    content[MULTIPART] = {
        "schema": {
            "type": "object",
            "required": ["evaluation", FILES],
            "properties": {
                "evaluation": content["application/json"]["schema"],
                FILES: {"type": "array", "items": file},
            },
        },
        "encoding": {"evaluation": {"contentType": "application/json"}},
    }
    return description
