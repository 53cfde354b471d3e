"""The asyncio clients' calls about evaluations."""

from __future__ import annotations

import abc
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import TypeVar, Unpack

from trajectron_client import evaluation_operations as operations
from trajectron_client.evaluations import (
    Evaluation,
    EvaluationOptions,
    RecordingFile,
    ResultFormat,
)
from trajectron_client.operations import Operation

T = TypeVar("T")


class AsyncEvaluations(abc.ABC):
    """What one can ask of the service about batch evaluations."""

    @abc.abstractmethod
    async def _run(self, operation: Operation[T], timeout_s: float | None) -> T:
        """Carries a call out."""

    @abc.abstractmethod
    def watch_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> AsyncIterator[Evaluation]:
        """The evaluation as it is now, and again whenever it has changed, until it has ended.

        Args:
            evaluation_id: which.
            timeout_s: over gRPC for the whole watch, None for no limit; over HTTP for any
                silence of the server, None for a minute.

        Raises:
            UnknownEvaluationError: there is no such evaluation, or it was deleted meanwhile.
            DrainingError: the server is stopping; it will go on with the evaluation.
        """

    async def create_evaluation(
        self,
        models: Sequence[str],
        *,
        files: Sequence[RecordingFile | str | Path] = (),
        timeout_s: float | None = None,
        **options: Unpack[EvaluationOptions],
    ) -> Evaluation:
        """Queues an evaluation, of a data set or of files.

        Args:
            models: names of the models and baselines to compare, in order.
            files: recordings to judge on, in place of ``dataset``; paths are read here.
            timeout_s: see the client.
            **options: see ``EvaluationOptions``.

        Raises:
            InvalidArgumentError: a field is at fault, or a line of a file.
            UnknownModelError: there is no such model.
            DatasetUnavailableError: the server has not got the data set.
            EvaluationExistsError: the id is taken.
            OverloadedError: the queue is full.
            TooManyEvaluationsError: the server keeps as many as it may.
        """
        return await self._run(operations.create(models, files, options), timeout_s)

    async def get_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> Evaluation:
        """An evaluation as it is now; raises ``UnknownEvaluationError``."""
        return await self._run(operations.get(evaluation_id), timeout_s)

    async def list_evaluations(
        self, *, page_size: int | None = None, timeout_s: float | None = None
    ) -> AsyncIterator[Evaluation]:
        """All evaluations, the newest first, fetched a page at a time."""
        token = ""
        while True:
            page, token = await self._run(operations.list_page(page_size, token), timeout_s)
            for evaluation in page:
                yield evaluation
            if not token:
                return

    async def cancel_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> Evaluation:
        """Ends an evaluation; one that has ended stays as it is.

        Raises:
            UnknownEvaluationError: there is no such evaluation.
        """
        return await self._run(operations.cancel(evaluation_id), timeout_s)

    async def delete_evaluation(
        self, evaluation_id: str, *, timeout_s: float | None = None
    ) -> None:
        """Removes an evaluation and its files; ends it first where it is running.

        Raises:
            UnknownEvaluationError: there is no such evaluation.
        """
        await self._run(operations.delete(evaluation_id), timeout_s)

    async def evaluation_result(
        self, evaluation_id: str, form: ResultFormat = "json", *, timeout_s: float | None = None
    ) -> bytes:
        """The result of an evaluation that has succeeded, as a file of that form.

        Raises:
            NoResultError: it has not ended, or not well.
            UnknownEvaluationError: there is no such evaluation.
        """
        return await self._run(operations.result(evaluation_id, form), timeout_s)
