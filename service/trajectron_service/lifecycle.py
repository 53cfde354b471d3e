"""The life of the process: everything is built here, started, and stopped in good order.

Both servers share one event loop. Start: ports are bound, models loaded, servers up, models
warmed up; only then is the service ready. Stop, on SIGTERM or SIGINT: health turns, new work
is refused, work in hand finishes within ``drain_grace_s``, then the servers close.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import signal
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from importlib import metadata

from trajectron_service import engine, logs
from trajectron_service.admission import Admission
from trajectron_service.application import Application
from trajectron_service.evaluations.jobs import Evaluations
from trajectron_service.grpc_server import SERVICES, grpc_server
from trajectron_service.health import Health
from trajectron_service.http_connections import ConnectionLimits, bounded_protocol
from trajectron_service.http_routes import http_app, operations_app
from trajectron_service.http_server import HttpServer, listen
from trajectron_service.lag import measure_lag
from trajectron_service.metrics import Metrics
from trajectron_service.protection import check_exposure, load_tls
from trajectron_service.quotas import Usage, unlimited
from trajectron_service.settings import Settings, SettingsError
from trajectron_service.stores import SessionStore
from trajectron_service.stores.opening import open_store
from trajectron_service.tokens import Tokens
from trajectron_service.tracing import OFF, Tracing
from trajectron_service.work import WorkInHand

DISTRIBUTION = "trajectron-service"

# The work itself has finished by then: time for the last bytes of calls.
_LAST_BYTES_S = 1.0

log = logs.get(__name__)


class LeftBehindError(Exception):
    """Everything has stopped but the inference thread, which cannot be interrupted."""


@dataclass(frozen=True)
class Service:
    """A running service: what it is made of, and the ports that it got."""

    application: Application
    evaluations: Evaluations
    health: Health
    metrics: Metrics
    store: SessionStore
    admission: Admission
    http_port: int
    grpc_port: int
    metrics_port: int | None


def serve(settings: Settings) -> None:
    """Runs the service until SIGTERM or SIGINT, and stops in good order.

    Raises:
        SettingsError: a port is taken, or a model cannot be loaded.
    """
    logs.configure(settings.log_level, settings.log_format)
    try:
        asyncio.run(_serve(settings))
    except LeftBehindError as error:
        log.warning("stopped", reason=str(error))
        logging.shutdown()
        # Python itself would wait for the thread, however long it takes.
        os._exit(0)


async def _serve(settings: Settings) -> None:
    with _stop_signals() as stop:
        async with running(settings) as service:
            # What is here now stays: no collection of cycles need look at it again.
            gc.collect()
            gc.freeze()
            loop = asyncio.get_running_loop()
            loop.add_signal_handler(signal.SIGHUP, service.admission.reload)
            log.info(
                "ready",
                host=settings.host,
                http_port=service.http_port,
                grpc_port=service.grpc_port,
                metrics_port=service.metrics_port or service.http_port,
                store=service.store.kind,
                durability=service.store.durability.value,
                models=[model.name for model in service.application.list_models()],
                kernels=next(model.kernels for model in service.application.list_models()),
            )
            await stop.wait()
            log.info("draining", grace_s=settings.drain_grace_s)
        log.info("stopped")


@asynccontextmanager
async def running(settings: Settings, tracing: Tracing | None = None) -> AsyncIterator[Service]:
    """The service, ready, on its ports; drained and stopped at the end of the block.

    Args:
        settings: of everything.
        tracing: told of calls; as the settings say when None.

    Raises:
        SettingsError: a port is taken, a model, certificate or file of tokens cannot be loaded,
            or other machines would be served unprotected.
        LeftBehindError: at the end, when the model was still at work after the grace.
    """
    check_exposure(settings)
    tls = load_tls(settings)
    tokens = None if settings.tokens is None else Tokens(settings.tokens)
    metrics = Metrics(tracing or _tracing(settings))
    usage = unlimited(metrics) if tokens is None else Usage(tokens.quotas, metrics)
    admission = Admission(tokens, metrics, usage)
    metrics.build(version())
    health = Health(*SERVICES)
    await health.starting()
    async with AsyncExitStack() as stack:
        stack.push_async_callback(asyncio.to_thread, metrics.tracing.close)
        with _port("http_port", settings.host, settings.http_port):
            listener = stack.enter_context(listen(settings.host, settings.http_port))
        loaded = engine.load(settings, metrics.staged)
        work = WorkInHand(metrics)
        store = await open_store(settings, metrics)
        stack.push_async_callback(store.close)
        application = Application(settings, loaded, metrics, work=work, store=store, usage=usage)
        stack.push_async_callback(_close, application)
        evaluations = Evaluations(settings, metrics, work, usage=usage)
        stack.push_async_callback(evaluations.close)
        calls = grpc_server(application, evaluations, health, metrics, admission, settings)
        with _port("grpc_port", settings.host, settings.grpc_port):
            # gRPC itself would not say why it cannot bind, but log on its own.
            listen(settings.host, settings.grpc_port).close()
            address = _address(settings.host, settings.grpc_port)
            grpc_port = (
                calls.add_secure_port(address, tls.grpc)
                if tls
                else calls.add_insecure_port(address)
            )
        protocol = bounded_protocol(
            ConnectionLimits(settings.max_connections, settings.receive_timeout_s), metrics
        )
        pages = HttpServer(
            http_app(
                application,
                evaluations,
                health,
                metrics,
                admission,
                max_body_bytes=settings.max_message_bytes,
                max_arriving_bytes=settings.max_arriving_bytes,
                metrics_here=settings.metrics_port is None,
                version=version(),
            ),
            listener,
            protocol,
            tls.http if tls else None,
        )
        metrics_port = None
        if settings.metrics_port is not None:
            with _port("metrics_port", settings.metrics_host, settings.metrics_port):
                own = stack.enter_context(listen(settings.metrics_host, settings.metrics_port))
            metrics_port = own.getsockname()[1]
            operations = HttpServer(operations_app(health, metrics), own, protocol)
            await operations.start()
            stack.push_async_callback(operations.stop)
        await calls.start()
        stack.push_async_callback(calls.stop, _LAST_BYTES_S)
        await pages.start()
        stack.push_async_callback(pages.stop)
        stack.push_async_callback(_drain, application, evaluations, health, settings.drain_grace_s)
        for watch, name in (
            (admission.keep_watch(), "tokens"),
            (measure_lag(metrics.loop_lag), "lag"),
        ):
            stack.callback(asyncio.create_task(watch, name=name).cancel)
        await application.start()
        await evaluations.start()
        await health.ready()
        http_port = listener.getsockname()[1]
        yield Service(
            application,
            evaluations,
            health,
            metrics,
            store,
            admission,
            http_port,
            grpc_port,
            metrics_port,
        )


def _tracing(settings: Settings) -> Tracing:
    if settings.tracing == "off":
        return OFF
    try:
        # Not everybody has installed it.
        from trajectron_service import telemetry  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"tracing: {settings.tracing!r} needs the package {error.name}; "
            "install trajectron-service[service,tracing]"
        ) from error
    return telemetry.exporting(settings.tracing_endpoint, settings.tracing_share, version())


async def _drain(
    application: Application, evaluations: Evaluations, health: Health, grace_s: float
) -> None:
    """Health turns and new work is refused at once; work in hand has ``grace_s`` to finish.

    An evaluation is no work in hand: it is ended later, and taken up at the next start.
    """
    await health.draining()
    application.begin_drain()
    evaluations.begin_drain()
    try:
        async with asyncio.timeout(grace_s):
            await application.drained()
    except TimeoutError:
        log.warning("work in hand is cut off", grace_s=grace_s)


async def _close(application: Application) -> None:
    try:
        async with asyncio.timeout(_LAST_BYTES_S):
            await application.close()
    except TimeoutError:
        raise LeftBehindError("the model was still at work; nobody waits for it") from None


@contextmanager
def _port(setting: str, host: str, port: int) -> Iterator[None]:
    """Turns a failure to bind into an error that names the setting."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "the port may be in use"
        raise SettingsError(f"{setting}: cannot listen on {host}:{port}: {reason}") from error


@contextmanager
def _stop_signals() -> Iterator[asyncio.Event]:
    """An event that the first SIGTERM or SIGINT sets; a second one acts as it always does."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    signals = (signal.SIGTERM, signal.SIGINT)

    def on_signal() -> None:
        stop.set()
        for number in signals:
            loop.remove_signal_handler(number)

    for number in signals:
        loop.add_signal_handler(number, on_signal)
    try:
        yield stop
    finally:
        for number in signals:
            loop.remove_signal_handler(number)


def _address(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def version() -> str:
    """Of the installed distribution; ``unknown`` when run from a bare source tree."""
    try:
        return metadata.version(DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return "unknown"
