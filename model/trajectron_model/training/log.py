"""The log of a training for TensorBoard."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

from torch.utils.tensorboard import SummaryWriter

from trajectron_model.training.trainer import Progress


class TensorBoardLog:
    """Writes each step's loss terms and each validation's figures as scalars to a folder."""

    def __init__(self, folder: Path) -> None:
        self._writer = SummaryWriter(str(folder))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.close()

    def record(self, progress: Progress) -> None:
        """One step."""
        for name, value in progress.terms._asdict().items():
            self._scalar(f"training/{name}", float(value), progress.step)
        self._scalar("training/learning_rate", progress.learning_rate, progress.step)
        if progress.figures is not None:
            for name, figure in progress.figures._asdict().items():
                self._scalar(f"validation/{name}", figure, progress.step)

    def _scalar(self, name: str, value: float, step: int) -> None:
        self._writer.add_scalar(name, value, step)
