"""The one error of the data readers."""

from __future__ import annotations

from pathlib import Path

_LONGEST = 400


class DataError(ValueError):
    """A file that cannot be read as a recording; the message begins with ``FILE:LINE:``.

    Args:
        path: the file at fault.
        line: its line at fault, counted from 1; None where the fault is of the whole file.
        reason: what is wrong, and what would be right; a long one loses its middle, which is a
            cell of the file and no use to anybody.
    """

    def __init__(self, path: str | Path, line: int | None, reason: str) -> None:
        if len(reason) > _LONGEST:
            reason = f"{reason[: _LONGEST // 2]} ... {reason[-_LONGEST // 2 :]}"
        place = f"{path}:{line}" if line is not None else f"{path}"
        super().__init__(f"{place}: {reason}")
        self.path = Path(path)
        self.line = line
        self.reason = reason
