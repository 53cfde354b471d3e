"""Generates the Python code of the contract; with ``--check``, says whether it is current.

Both ways end with ``buf lint``, which reads a compiled image so that it needs no
network: the imported google/rpc protos come from the installed googleapis-common-protos.
"""

from __future__ import annotations

import argparse
import filecmp
import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PROTOS = ROOT / "protos"
GENERATED = PROTOS / "trajectron_proto" / "v1"


def _google_include() -> Path:
    """The directory that ``google/rpc/status.proto`` is found under."""
    spec = importlib.util.find_spec("google.rpc.status_pb2")
    if spec is None or spec.origin is None:
        raise SystemExit("googleapis-common-protos is missing: run `make install`")
    return Path(spec.origin).parents[2]


def _run(command: list[str]) -> None:
    """Runs one tool of the virtual environment; ends the script when it fails."""
    scripts = sysconfig.get_path("scripts")
    path = os.pathsep.join([scripts, os.environ.get("PATH", "")])
    result = subprocess.run(command, cwd=ROOT, env={**os.environ, "PATH": path}, check=False)
    if result.returncode != 0:
        raise SystemExit(f"{' '.join(command[:3])} ... failed ({result.returncode})")


def _protoc(*arguments: str) -> None:
    _run([sys.executable, "-m", "grpc_tools.protoc", f"-I{_google_include()}", *arguments])


def _generate(out: Path) -> Path:
    """Writes the code under ``out`` and returns the package's directory.

    The virtual root makes the generated imports say ``trajectron_proto.v1``.
    """
    _protoc(
        f"-Itrajectron_proto={PROTOS / 'trajectron'}",
        f"--python_out={out}",
        f"--grpc_python_out={out}",
        f"--mypy_out={out}",
        f"--mypy_grpc_out={out}",
        *(f"trajectron_proto/{p.relative_to(PROTOS / 'trajectron')}" for p in _sources()),
    )
    return out / "trajectron_proto" / "v1"


def _sources() -> list[Path]:
    return sorted((PROTOS / "trajectron").rglob("*.proto"))


def _lint(scratch: Path) -> None:
    image = scratch / "contract.binpb"
    names = [str(p.relative_to(PROTOS)) for p in _sources()]
    _protoc(f"-I{PROTOS}", "--include_imports", "--include_source_info", f"-o{image}", *names)
    paths = [f"--path={name}" for name in names]
    _run(["buf", "lint", str(image), f"--config={PROTOS / 'buf.yaml'}", *paths])


def _stale(fresh: Path) -> list[str]:
    """Names of generated files that differ, are missing, or have no source any more."""
    committed = {p.name for p in GENERATED.glob("*_pb2*") if p.is_file()}
    names = sorted(committed | {p.name for p in fresh.iterdir()})
    _, differing, missing = filecmp.cmpfiles(fresh, GENERATED, names, shallow=False)
    return sorted([*differing, *missing])


def main() -> int:
    """Generates or checks; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    check = parser.parse_args().check
    with tempfile.TemporaryDirectory() as name:
        fresh = _generate(Path(name))
        stale = _stale(fresh)
        if check and stale:
            print(f"not current: {', '.join(stale)}; run `make protos`", file=sys.stderr)
            return 1
        if stale:
            for old in GENERATED.glob("*_pb2*"):
                old.unlink()
            for new in fresh.iterdir():
                shutil.copy(new, GENERATED / new.name)
        _lint(Path(name))
    print("protos: " + ("current" if check else f"{len(stale)} files written") + ", lint clean")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
