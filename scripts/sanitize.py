"""Runs the kernels' tests under address and undefined-behaviour sanitizers.

    python scripts/sanitize.py [pytest arguments]

A faulty index in a kernel may go unseen for long and then end the service. Built with
sanitizers, the first one ends the run and is told with its line. A compiler that has them is
needed (gcc, or clang with its run-time library).
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]
TESTS = (
    "tests/model/test_kernel_decoding.py",
    "tests/model/test_kernel_dense.py",
    "tests/model/test_kernel_placing.py",
    "tests/model/test_packed.py",
)
UNABLE = 3
"""Exit code where no compiler here has sanitizers."""


def main(arguments: list[str]) -> int:
    """Builds, then runs pytest with what it is given, by default the kernels' tests."""
    build = _build_module()
    compiler = build.find_compiler()
    runtime = None if compiler is None else _runtime(compiler)
    if compiler is None or runtime is None:
        sys.stderr.write("no compiler with sanitizers here\n")
        return UNABLE
    variant = _variant(build)
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "sanitized.so"
        build.compile_library(compiler, variant, library, build.SANITIZER_FLAGS)
        environment = os.environ | {
            "LD_PRELOAD": runtime,
            "TRAJECTRON_KERNELS": str(library),
            # Python itself leaves memory behind at its end.
            "ASAN_OPTIONS": "detect_leaks=0",
            "PYTHONMALLOC": "malloc",  # its own pools would hide where a small block ends
            "UBSAN_OPTIONS": "print_stacktrace=1",
        }
        command = [sys.executable, "-m", "pytest", *(arguments or TESTS)]
        return subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode


def _build_module() -> ModuleType:
    """The build script by its path: importing the package would load its kernels."""
    path = ROOT / "model" / "trajectron_model" / "kernels" / "build.py"
    spec = importlib.util.spec_from_file_location("kernels_build", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _variant(build: ModuleType) -> object:
    """The widest instruction set that this processor has."""
    text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    able = set(text.split())
    return next(variant for variant in build.variants() if variant.needs <= able)


def _runtime(compiler: tuple[str, ...]) -> str | None:
    """The sanitizers' library, which has to be in the process before Python starts."""
    asked = subprocess.run(
        [*compiler, "-print-file-name=libasan.so"], capture_output=True, text=True, check=False
    )
    path = Path(asked.stdout.strip())
    return str(path.resolve()) if asked.returncode == 0 and path.is_absolute() else None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
