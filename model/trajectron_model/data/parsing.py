"""Text into rows, each with its line, and rows into agents: what the readers share.

Everything here raises `DataError`, ``FILE:LINE: reason``.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trajectron_model.data.errors import DataError

CSV_COLUMNS = ("time", "id", "type", "x", "y")


@dataclass(frozen=True)
class Rows:
    """A file's rows; R of them.

    Attributes:
        line: [R] line in the file, from 1.
        time: [R] seconds, or frame numbers.
        id, type: [R].
        position: [R, 2] metres.
    """

    line: NDArray[np.int64]
    time: NDArray[np.float64]
    id: list[str]
    type: list[str]
    position: NDArray[np.float64]


def load(path: Path) -> tuple[str, str]:
    """The file's text and the SHA-256 of its bytes."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(path, None, error.strerror or str(error)) from error
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise DataError(path, line, "not UTF-8 text") from error
    if not text.strip():
        raise DataError(path, 1, "the file is empty")
    return text, hashlib.sha256(data).hexdigest()


def _number(path: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise DataError(path, line, f"{column} is {text!r}, not a number") from None
    if not math.isfinite(value):
        raise DataError(path, line, f"{column} is {text}; it must be finite")
    return value


def whitespace_rows(
    path: Path, text: str, columns: int, *, type_column: int | None, only_type: str
) -> Rows:
    """Rows of frame, id, [type,] x, y, ... split by whitespace; all columns must be numbers."""
    names = ["frame", "id", "x", "y"] if type_column is None else ["frame", "id", "type", "x", "y"]
    names += [f"column {n}" for n in range(len(names) + 1, columns + 1)]
    x = names.index("x")
    lines: list[int] = []
    values: list[list[float]] = []
    for line, row in enumerate(text.splitlines(), start=1):
        cells = row.split()
        if not cells:
            continue
        if len(cells) != columns:
            raise DataError(path, line, f"{len(cells)} columns; expected {columns}")
        values.append([_number(path, line, *cell) for cell in zip(names, cells, strict=True)])
        lines.append(line)
    table = np.array(values)  # [R, columns]
    ids = [str(int(v)) if v.is_integer() else str(v) for v in table[:, 1].tolist()]
    types = (
        [only_type] * len(ids)
        if type_column is None
        else [f"{v:g}" for v in table[:, type_column].tolist()]
    )
    return Rows(np.array(lines), table[:, 0], ids, types, table[:, x : x + 2])


def csv_rows(path: Path, text: str) -> Rows:
    """Rows of CSV under a header of `CSV_COLUMNS`, in any order."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    lines: list[int] = []
    ids: list[str] = []
    types: list[str] = []
    values: list[tuple[float, float, float]] = []
    order: list[int] | None = None
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            line = reader.line_num
            if order is None:
                order = _csv_order(path, line, cells)
                continue
            if len(cells) != len(CSV_COLUMNS):
                reason = f"{len(cells)} columns; expected {len(CSV_COLUMNS)}"
                raise DataError(path, line, reason)
            time, id_, type_, x, y = (cells[index] for index in order)
            if not id_ or not type_:
                raise DataError(path, line, f"{'type' if id_ else 'id'} is empty")
            numbers = zip(("time", "x", "y"), (time, x, y), strict=True)
            t_s, x_m, y_m = (_number(path, line, name, cell) for name, cell in numbers)
            lines.append(line)
            ids.append(id_)
            types.append(type_)
            values.append((t_s, x_m, y_m))
    except csv.Error as error:
        raise DataError(path, reader.line_num, f"not CSV: {error}") from error
    if not values:
        raise DataError(path, reader.line_num, "there are no rows after the header")
    table = np.array(values)  # [R, 3]
    return Rows(np.array(lines), table[:, 0], ids, types, table[:, 1:])


def _csv_order(path: Path, line: int, header: list[str]) -> list[int]:
    """Where each of `CSV_COLUMNS` stands in the header."""
    names = [name.lower() for name in header]
    if sorted(names) != sorted(CSV_COLUMNS):
        reason = f"the header is {','.join(header)}; expected {','.join(CSV_COLUMNS)}"
        raise DataError(path, line, reason)
    return [names.index(column) for column in CSV_COLUMNS]


def agents_of(path: Path, rows: Rows) -> tuple[tuple[str, ...], tuple[str, ...], NDArray[np.int64]]:
    """The file's agents, in the order in which they appear (by time, then by line).

    Returns:
        ids, types: [A].
        agent: [R] index into them.

    Raises:
        DataError: an agent twice at one time, or of two types.
    """
    index: dict[str, int] = {}
    types: list[str] = []
    seen: dict[tuple[float, int], int] = {}
    agent = np.empty(len(rows.id), dtype=np.int64)
    for row in np.argsort(rows.time, kind="stable").tolist():
        line, id_, time = int(rows.line[row]), rows.id[row], float(rows.time[row])
        number = index.setdefault(id_, len(index))
        agent[row] = number
        if number == len(types):
            types.append(rows.type[row])
        elif types[number] != rows.type[row]:
            reason = f"agent {id_} is a {rows.type[row]} here and a {types[number]} before"
            raise DataError(path, line, reason)
        other = seen.setdefault((time, number), line)
        if other != line:
            raise DataError(path, line, f"agent {id_} is at time {time:g} on line {other} already")
    return tuple(index), tuple(types), agent
