"""Which path leads where: the fastapi application."""

from __future__ import annotations

from fastapi import APIRouter, FastAPI
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response

from trajectron_service import http_answers as answers
from trajectron_service import http_errors
from trajectron_service.admission import Admission
from trajectron_service.application import Application
from trajectron_service.errors import ServiceError
from trajectron_service.evaluations.jobs import Evaluations
from trajectron_service.health import Health, Phase
from trajectron_service.http_api import HttpApi, json_response
from trajectron_service.http_body import Arriving
from trajectron_service.http_docs import BINARY, add_docs, errors, takes
from trajectron_service.http_evaluation_routes import evaluation_routes
from trajectron_service.http_evaluations import HttpEvaluations
from trajectron_service.http_middleware import RequestMiddleware
from trajectron_service.http_schemas import (
    CreateSessionRequest,
    ObserveRequest,
    PredictRequest,
    PredictSessionRequest,
)
from trajectron_service.metrics import CONTENT_TYPE, Metrics


def http_app(
    application: Application,
    evaluations: Evaluations,
    health: Health,
    metrics: Metrics,
    admission: Admission,
    *,
    max_body_bytes: int,
    max_arriving_bytes: int,
    metrics_here: bool,
    version: str,
) -> FastAPI:
    """Everything that is served over HTTP.

    Args:
        application: the core: sessions and forecasts.
        evaluations: the core: batch evaluations.
        health: what ``/readyz`` tells.
        metrics: what ``/metrics`` tells.
        admission: who is let in.
        max_body_bytes: larger bodies are refused while they are read.
        max_arriving_bytes: of all bodies being read; more are refused, too.
        metrics_here: whether ``/metrics`` is among it; else `operations_app` has it.
        version: of the distribution, for the OpenAPI page.
    """
    app = _bare_app()
    app.state.metrics = metrics
    app.state.arriving = Arriving(max(max_arriving_bytes, max_body_bytes))
    app.add_middleware(RequestMiddleware, metrics=metrics, admission=admission)
    app.add_exception_handler(ServiceError, http_errors.on_service_error)
    app.add_exception_handler(HTTPException, http_errors.on_http_exception)
    app.add_exception_handler(RequestValidationError, http_errors.on_invalid_parameters)
    api = HttpApi(application, max_body_bytes)
    app.include_router(_predictions(api))
    app.include_router(_sessions(api))
    app.include_router(evaluation_routes(HttpEvaluations(evaluations, max_body_bytes)))
    app.include_router(_probes(health))
    if metrics_here:
        app.include_router(_measurements(metrics))
    add_docs(app, version)
    return app


def operations_app(health: Health, metrics: Metrics) -> FastAPI:
    """Metrics and probes alone, for a port of their own: nobody is asked who they are."""
    app = _bare_app()
    app.include_router(_probes(health))
    app.include_router(_measurements(metrics))
    return app


def _bare_app() -> FastAPI:
    return FastAPI(openapi_url=None, docs_url=None, redoc_url=None, redirect_slashes=False)


def _predictions(api: HttpApi) -> APIRouter:
    router = APIRouter(tags=["predictions"])
    for path in ("/v1/predict", "/predict"):
        router.add_api_route(
            path,
            api.predict,
            methods=["POST"],
            summary="Predict" + (" (short path)" if path == "/predict" else ""),
            operation_id="predict" + ("_short" if path == "/predict" else ""),
            response_model=answers.Forecast,
            responses={200: BINARY, **errors(400, 404, 413, 422, 429, 503, 504)},
            openapi_extra=takes(PredictRequest),
        )
    router.add_api_route(
        "/v1/models",
        api.list_models,
        methods=["GET"],
        summary="List models",
        operation_id="list_models",
        response_model=answers.Models,
        responses={200: BINARY, **errors()},
    )
    return router


def _sessions(api: HttpApi) -> APIRouter:
    router = APIRouter(tags=["sessions"])
    router.add_api_route(
        "/v1/sessions",
        api.create_session,
        methods=["POST"],
        status_code=201,
        summary="Create a session",
        operation_id="create_session",
        response_model=answers.Session,
        responses={201: BINARY, **errors(400, 404, 409, 413, 422, 429, 503)},
        openapi_extra=takes(CreateSessionRequest, required=False),
    )
    router.add_api_route(
        "/v1/sessions",
        api.list_sessions,
        methods=["GET"],
        summary="List sessions",
        operation_id="list_sessions",
        response_model=answers.Sessions,
        responses={200: BINARY, **errors(422)},
    )
    router.add_api_route(
        "/v1/sessions/{session_id}:observe",
        api.observe,
        methods=["POST"],
        summary="Observe frames",
        operation_id="observe",
        response_model=answers.FrameResults,
        responses={200: BINARY, **errors(400, 404, 409, 410, 413, 422, 429, 503, 504)},
        openapi_extra=takes(ObserveRequest),
    )
    router.add_api_route(
        "/v1/sessions/{session_id}:predict",
        api.predict_session,
        methods=["POST"],
        summary="Predict from a session",
        operation_id="predict_session",
        response_model=answers.Forecast,
        responses={200: BINARY, **errors(400, 404, 409, 410, 413, 422, 429, 503, 504)},
        openapi_extra=takes(PredictSessionRequest, required=False),
    )
    router.add_api_route(
        "/v1/sessions/{session_id}",
        api.get_session,
        methods=["GET"],
        summary="Get a session and its graph",
        operation_id="get_session",
        response_model=answers.SessionWithGraph,
        responses={200: BINARY, **errors(404, 410, 422, 503)},
    )
    router.add_api_route(
        "/v1/sessions/{session_id}",
        api.delete_session,
        methods=["DELETE"],
        status_code=204,
        summary="Delete a session",
        operation_id="delete_session",
        responses=errors(404, 410, 422, 503),
    )
    return router


def _probes(health: Health) -> APIRouter:
    router = APIRouter(tags=["operations"])

    @router.get(
        "/healthz", response_model=answers.Status, summary="Liveness", operation_id="healthz"
    )
    async def is_alive() -> Response:
        """Whether the process lives."""
        return json_response({"status": "ok"})

    @router.get(
        "/readyz",
        response_model=answers.Status,
        summary="Readiness",
        operation_id="readyz",
        responses={503: {"model": answers.Status, "description": "Starting or draining."}},
    )
    async def is_ready() -> Response:
        """Whether work is welcome: models loaded, warmed up, not draining."""
        ready = health.phase is Phase.READY
        status = "ok" if ready else health.phase.value
        return json_response({"status": status}, 200 if ready else 503)

    return router


def _measurements(metrics: Metrics) -> APIRouter:
    router = APIRouter(tags=["operations"])

    @router.get("/metrics", summary="Metrics", operation_id="metrics", response_class=Response)
    async def measurements() -> Response:
        """Gives metrics in the Prometheus text format."""
        return Response(metrics.render(), media_type=CONTENT_TYPE)

    return router
