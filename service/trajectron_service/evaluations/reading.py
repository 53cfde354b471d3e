"""Reads recordings that were sent along, in a process of its own: large ones take seconds.

The module's arguments are the frames of a step and the files. It tells nothing when all of them
can be read, and otherwise which one cannot, on which line, and why.
"""

from __future__ import annotations

import sys

from trajectron_model.data import readers
from trajectron_model.data.errors import DataError
from trajectron_service.evaluations.launch import say


def main(frames_per_step: int, files: list[str]) -> None:
    """Reads every file, up to the first that is at fault."""
    for place, file in enumerate(files):
        try:
            readers.read(file, frames_per_step=frames_per_step)
        except DataError as error:
            say({"file": place, "line": error.line, "reason": error.reason})
            return


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
