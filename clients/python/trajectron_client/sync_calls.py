"""The calls of the synchronous clients; each transport says how one is carried out."""

from __future__ import annotations

import abc
import contextlib
from collections.abc import Iterable, Iterator, Mapping
from typing import TypeVar, Unpack

from trajectron_client import operations
from trajectron_client.exceptions import TrajectronError, UnknownSessionError
from trajectron_client.forecast import Forecast
from trajectron_client.replies import FrameResult, ModelInfo, SessionInfo, SessionSnapshot
from trajectron_client.scene import ForecastOptions, Frame, SessionOptions, UnknownTypes
from trajectron_client.sync_evaluations import SyncEvaluations

T = TypeVar("T")


class SyncCalls(SyncEvaluations):
    """What one can ask of the service.

    Every call takes ``timeout_s``, in place of the client's own, and raises
    ``DeadlineExceededError`` when no answer came in time, ``TransportError`` when the service
    could not be reached, and otherwise the errors named, or others below ``ServiceError``.
    """

    @abc.abstractmethod
    def is_ready(self, *, timeout_s: float | None = None) -> bool:
        """Whether the service takes work now; False as well when it cannot be reached."""

    @abc.abstractmethod
    def wait_until_ready(self, timeout_s: float = 60.0) -> None:
        """Returns once the service takes work; raises ``DeadlineExceededError`` otherwise."""

    def predict(
        self,
        frames: Iterable[Frame],
        *,
        model: str | None = None,
        unknown_types: UnknownTypes = "reject",
        type_map: Mapping[str, str] | None = None,
        frame_interval_s: float | None = None,
        timeout_s: float | None = None,
        **options: Unpack[ForecastOptions],
    ) -> Forecast:
        """Forecasts from a scene's history; the service keeps nothing.

        Args:
            frames: the history, in order of time; at least one frame.
            model: a name from ``list_models()``; the server's default when None.
            unknown_types: what happens to agents of types that the model does not know.
            type_map: from your types to the model's, for ``unknown_types="map"``.
            frame_interval_s: expected seconds between frames; the model's dt when None.
            timeout_s: see the class.
            **options: see ``ForecastOptions``.

        Raises:
            InvalidArgumentError: a frame or an option is at fault; ``violations`` names the field.
            UnknownModelError: there is no such model.
            OverloadedError: the server's queue is full.
        """
        operation = operations.predict(
            frames,
            model=model,
            unknown_types=unknown_types,
            type_map=type_map,
            frame_interval_s=frame_interval_s,
            options=options,
        )
        return self._run(operation, timeout_s)

    @contextlib.contextmanager
    def session(
        self, session_id: str | None = None, **options: Unpack[SessionOptions]
    ) -> Iterator[Session]:
        """A new session for the length of a ``with`` block, deleted at its end.

        Args:
            session_id: 1 to 128 of ``[A-Za-z0-9._-]``; named by the server when None.
            **options: see ``SessionOptions``.

        Raises:
            SessionExistsError: the id is taken.
        """
        session = self.attach(self.create_session(session_id, **options).id)
        try:
            yield session
        except BaseException:
            # The block's own error tells more than one of closing would.
            with contextlib.suppress(TrajectronError):
                session.delete()
            raise
        # One that timed out, or was deleted in the block, is closed already.
        with contextlib.suppress(UnknownSessionError):
            session.delete()

    def attach(self, session_id: str) -> Session:
        """A handle to a session that exists; nothing is sent, and it is not deleted for you."""
        return Session(self, session_id)

    def create_session(
        self,
        session_id: str | None = None,
        *,
        timeout_s: float | None = None,
        **options: Unpack[SessionOptions],
    ) -> SessionInfo:
        """Opens a session that lives until it is deleted or idle for too long.

        Raises:
            SessionExistsError: the id is taken.
            TooManySessionsError: the server holds as many sessions as it may.
            UnknownModelError: there is no such model.
        """
        return self._run(operations.create_session(session_id, options), timeout_s)

    def get_session(self, session_id: str, *, timeout_s: float | None = None) -> SessionSnapshot:
        """A session with its graph: nodes, edges, ages, modulation.

        Raises:
            UnknownSessionError: it was never opened, was deleted, or timed out.
        """
        return self._run(operations.get_session(session_id), timeout_s)

    def list_sessions(
        self, *, page_size: int | None = None, timeout_s: float | None = None
    ) -> Iterator[SessionInfo]:
        """All open sessions in order of id, fetched a page at a time."""
        token = ""
        while True:
            sessions, token = self._run(operations.list_sessions(page_size, token), timeout_s)
            yield from sessions
            if not token:
                return

    def delete_session(self, session_id: str, *, timeout_s: float | None = None) -> None:
        """Closes a session and forgets its state.

        Raises:
            UnknownSessionError: there is no such session.
        """
        self._run(operations.delete_session(session_id), timeout_s)

    def observe(
        self, session_id: str, frame: Frame, *, timeout_s: float | None = None
    ) -> FrameResult:
        """Pushes one frame to a session.

        Raises:
            InvalidArgumentError: the frame is at fault; ``violations`` names the field.
            FrameConflictError: it has the newest frame's time, with other content.
            FrameOutOfOrderError: it is earlier than the newest frame.
            UnknownSessionError: there is no such session.
        """
        return self._run(operations.observe(session_id, (frame,)), timeout_s)[0]

    def observe_all(
        self, session_id: str, frames: Iterable[Frame], *, timeout_s: float | None = None
    ) -> tuple[FrameResult, ...]:
        """Pushes several frames, in order; each gets its result, and a refused one leaves the rest.

        A batch of one raises as ``observe`` does.

        Raises:
            UnknownSessionError: there is no such session.
        """
        return self._run(operations.observe(session_id, frames), timeout_s)

    def predict_session(
        self,
        session_id: str,
        *,
        timeout_s: float | None = None,
        **options: Unpack[ForecastOptions],
    ) -> Forecast:
        """Forecasts from a session's newest frame.

        Raises:
            NoFramesError: the session has seen no frame yet.
            UnknownSessionError: there is no such session.
            UnknownAgentError: ``agents`` names one that is not in the scene.
        """
        return self._run(operations.predict_session(session_id, options), timeout_s)

    def list_models(self, *, timeout_s: float | None = None) -> tuple[ModelInfo, ...]:
        """The models that the server can run."""
        return self._run(operations.list_models(), timeout_s)


class Session:
    """A handle to one session: the same calls as the client's, without the id."""

    def __init__(self, client: SyncCalls, session_id: str) -> None:
        self._client = client
        self.id = session_id

    def observe(self, frame: Frame, *, timeout_s: float | None = None) -> FrameResult:
        """Pushes one frame; raises as the client's ``observe`` does."""
        return self._client.observe(self.id, frame, timeout_s=timeout_s)

    def observe_all(
        self, frames: Iterable[Frame], *, timeout_s: float | None = None
    ) -> tuple[FrameResult, ...]:
        """Pushes several frames, in order; each gets its result."""
        return self._client.observe_all(self.id, frames, timeout_s=timeout_s)

    def predict(
        self, *, timeout_s: float | None = None, **options: Unpack[ForecastOptions]
    ) -> Forecast:
        """Forecasts from the newest frame; raises ``NoFramesError`` before the first."""
        return self._client.predict_session(self.id, timeout_s=timeout_s, **options)

    def describe(self, *, timeout_s: float | None = None) -> SessionSnapshot:
        """The session as it is now, with its graph."""
        return self._client.get_session(self.id, timeout_s=timeout_s)

    def delete(self, *, timeout_s: float | None = None) -> None:
        """Closes the session and forgets its state."""
        self._client.delete_session(self.id, timeout_s=timeout_s)
