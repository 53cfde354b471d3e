"""Files that mean harm, or are merely broken: refused with their name, never more than that.

``HOSTILE_EXAMPLES=5000 pytest tests/model/test_hostile_files.py`` looks longer.
"""

from __future__ import annotations

import hashlib
import json
import os
import tracemalloc
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from trajectron_model import checkpoint
from trajectron_model.config import ModelConfig
from trajectron_model.data.errors import DataError
from trajectron_model.data.readers import read, read_apolloscape, read_csv, read_eth_ucy
from trajectron_model.data.recording import Recording
from trajectron_model.trajectron import Trajectron

MANY = settings(
    max_examples=int(os.environ.get("HOSTILE_EXAMPLES", "60")),
    deadline=None,
    derandomize="HOSTILE_EXAMPLES" not in os.environ,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
# More than any file here needs; a dense array over a gap of frames would need gigabytes.
MOST_BYTES = 64 * 2**20

SOUND = {
    "scene.csv": "time,id,type,x,y\n"
    + "".join(f"{0.4 * t:.1f},{a},pedestrian,{t}.5,{a}.25\n" for t in range(5) for a in range(3)),
    "scene.txt": "".join(f"{10 * t}\t{a}\t{t}.5\t{a}.25\n" for t in range(5) for a in range(3)),
    "apollo.txt": "".join(
        f"{t} {a} {1 + a} {t}.5 {a}.25 30.1 1.2 0.5 1.7 0.01\n" for t in range(5) for a in range(3)
    ),
}
READERS = (read, read_csv, read_eth_ucy, read_apolloscape)
CELLS = st.sampled_from(
    [
        "", "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "1e400", "9" * 400, "0x10", "1_0",
        "-0", "+1", "1e18", "9007199254740993", "\u0661", "\u202e", "\x00", '"', '"\n"',
        "a" * 3000, "../../x", "=1+1", "1,5", "\ud7ff", "\ufeff", "3.5", "7",
    ]
)  # fmt: skip


@st.composite
def broken_text(draw: st.DrawFn) -> tuple[str, bytes]:
    """A sound file with some cells, lines or bytes changed; or anything at all."""
    name = draw(st.sampled_from(sorted(SOUND)))
    if draw(st.integers(0, 9)) == 0:
        return name, draw(st.binary(max_size=300))
    comma = "," if name.endswith(".csv") else None
    rows = [line.split(comma) for line in SOUND[name].splitlines()]
    for _ in range(draw(st.integers(1, 4))):
        row = draw(st.integers(0, len(rows) - 1))
        change = draw(st.sampled_from(["cell", "drop", "repeat", "shorten", "lengthen"]))
        if change == "cell" and rows[row]:
            rows[row][draw(st.integers(0, len(rows[row]) - 1))] = draw(CELLS)
        elif change == "drop" and len(rows) > 1:
            del rows[row]
        elif change == "repeat":
            rows.insert(row, list(rows[row]))
        elif change == "shorten":
            rows[row] = rows[row][:-1]
        else:
            rows[row] = [*rows[row], draw(CELLS)]
    end = draw(st.sampled_from(["\n", "\r\n", "\r", "\u2028"]))
    text = end.join((comma or "\t").join(row) for row in rows) + end
    data = bytearray(text.encode("utf-8", "surrogatepass"))
    for _ in range(draw(st.integers(0, 2))):
        data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
    return name, bytes(data)


@MANY
@given(broken_text(), st.sampled_from(READERS))
def test_broken_recordings_are_read_or_refused_by_name_within_bounds(
    tmp_path: Path, file: tuple[str, bytes], reader: object
) -> None:
    name, data = file
    path = tmp_path / name
    path.write_bytes(data)
    tracemalloc.start()
    try:
        recording = reader(path)  # type: ignore[operator]
        assert isinstance(recording, Recording)
    except DataError as error:
        assert str(error).startswith(f"{path}:")  # noqa: PT017 - either is right
        assert len(str(error)) < 800  # noqa: PT017
    finally:
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert most < MOST_BYTES


@pytest.mark.parametrize("last", ["1e12", "1e15", "9e18", "1e300"])
def test_a_gap_without_end_is_refused_before_it_costs_memory(tmp_path: Path, last: str) -> None:
    for name, rows, reader in (
        ("gap.csv", f"time,id,type,x,y\n0,a,pedestrian,0,0\n{last},a,pedestrian,1,1\n", read_csv),
        ("gap.txt", f"0 1 0 0\n{last} 1 1 1\n", read_eth_ucy),
    ):
        path = tmp_path / name
        path.write_text(rows)
        tracemalloc.start()
        with pytest.raises(DataError, match="at most"):
            reader(path)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert most < MOST_BYTES


@pytest.fixture(scope="module")
def sound_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    stem = tmp_path_factory.mktemp("sound") / "model"
    torch.manual_seed(0)
    config = ModelConfig(history_size=2, edge_size=2, decoder_size=2, mixture_components=1)
    checkpoint.save(stem, Trajectron(config), {"task": "hostile files"})
    return stem


JSON_VALUES = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.floats(), st.text(max_size=9)
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)


@MANY
@given(st.data())
def test_broken_models_are_refused_in_words(
    tmp_path: Path, sound_model: Path, data: st.DataObject
) -> None:
    description = sound_model.with_suffix(".json").read_bytes()
    weights = bytearray(sound_model.with_suffix(".safetensors").read_bytes())
    kind = data.draw(st.sampled_from(["value", "bytes", "weights", "cut"]))
    if kind == "value":
        table = json.loads(description)
        place = data.draw(st.sampled_from([table, table["model"]]))
        place[data.draw(st.sampled_from(sorted(place)))] = data.draw(JSON_VALUES)
        description = json.dumps(table).encode()
    elif kind == "bytes":
        changed = bytearray(description)
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
        description = bytes(changed)
    elif kind == "weights":
        # The header above all: it says where in the file each tensor lies.
        for _ in range(data.draw(st.integers(1, 4))):
            weights[data.draw(st.integers(0, 600))] = data.draw(st.integers(0, 255))
    else:
        del weights[data.draw(st.integers(0, len(weights) - 1)) :]
    if kind in ("weights", "cut"):
        # Else the checksum would be all that is looked at.
        table = json.loads(description) | {"sha256": hashlib.sha256(weights).hexdigest()}
        description = json.dumps(table).encode()
    stem = tmp_path / "broken"
    stem.with_suffix(".json").write_bytes(description)
    stem.with_suffix(".safetensors").write_bytes(bytes(weights))
    try:
        loaded = checkpoint.Checkpoint.load(stem)
        assert isinstance(loaded.model, Trajectron)
    except ValueError as error:
        assert "broken" in str(error)  # noqa: PT017 - either is right
