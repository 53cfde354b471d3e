"""Compiles the kernels: one library for each instruction set, beside their sources.

Standard library only, and nothing of the package: the build hook (``hatch_build.py``) loads
this file before anything is installed.

    python model/trajectron_model/kernels/build.py [--force] [--requirement]

The compiler is ``$CC``, or cc, gcc or clang, whichever is found first, or else the one inside
the PyPI package ``ziglang``. Without any there are no libraries, and torch does the work.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

SOURCES = Path(__file__).parent
LIBRARIES = SOURCES / "lib"
# Brings a C compiler where the system has none; named here once, for the build hook and make.
COMPILER_PACKAGE = "ziglang"

_FLAGS = (
    "-std=c11",
    "-O3",
    "-ffp-contract=fast",  # a product and a sum become one instruction
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fvisibility=hidden",
    "-fPIC",
    "-shared",
)
SANITIZER_FLAGS = (
    "-g",
    "-O1",
    "-fno-omit-frame-pointer",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=undefined",
)


class BuildError(Exception):
    """There is no compiler, or it failed; says what it wrote."""


@dataclass(frozen=True)
class Variant:
    """A library for one instruction set.

    Attributes:
        name: of the set, and of the library's file.
        flags: that make the compiler use it.
        needs: flags of /proc/cpuinfo without which it cannot run.
    """

    name: str
    flags: tuple[str, ...]
    needs: frozenset[str]

    @property
    def file_name(self) -> str:
        """Of the library."""
        return f"trajectron-{self.name}.so"


_V2 = frozenset({"sse4_1", "sse4_2", "ssse3", "popcnt", "cx16"})
_V3 = _V2 | {"avx", "avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"}
_V4 = _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
# The compiler's names with _ for -, which is how zig's front end and the others both take them.
_X86_64 = (
    Variant("x86-64-v4", ("-march=x86-64-v4", "-mprefer-vector-width=512"), _V4),
    Variant("x86-64-v3", ("-march=x86-64-v3",), _V3),
    Variant("x86-64-v2", ("-march=x86-64-v2",), _V2),
)
_AARCH64 = (Variant("aarch64", ("-march=armv8-a",), frozenset()),)


def variants(machine: str = "") -> tuple[Variant, ...]:
    """The variants of a kind of machine (default: this one), the quickest first."""
    machine = (machine or platform.machine()).lower()
    if machine in ("x86_64", "amd64"):
        return _X86_64
    return _AARCH64 if machine in ("aarch64", "arm64") else ()


def find_compiler() -> tuple[str, ...] | None:
    """The command of a C compiler, or None."""
    asked = shlex.split(os.environ.get("CC", ""))
    if asked and shutil.which(asked[0]):
        return tuple(asked)
    for name in ("cc", "gcc", "clang"):
        if found := shutil.which(name):
            return (found,)
    if importlib.util.find_spec(COMPILER_PACKAGE):
        return (sys.executable, "-m", COMPILER_PACKAGE, "cc")
    return None


def sources() -> list[Path]:
    """Every C file and header, by name."""
    return sorted(p for p in SOURCES.iterdir() if p.suffix in (".c", ".h"))


def fingerprint() -> str:
    """Changes when the sources or this file do; a library says from which it was made."""
    digest = hashlib.sha256()
    for path in (*sources(), Path(__file__)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def compile_library(
    compiler: Sequence[str], variant: Variant, target: Path, extra: Sequence[str] = ()
) -> None:
    """Compiles all C files into one library; raises BuildError with the compiler's words."""
    units = [str(path) for path in sources() if path.suffix == ".c"]
    partial = target.with_suffix(f".{os.getpid()}.partial")
    made_from = f'-DTRAJECTRON_FINGERPRINT="{fingerprint()}"'
    flags = [*_zig_names(compiler, (*_FLAGS, *variant.flags)), made_from, *extra]
    command = [*compiler, *flags, "-o", str(partial), *units, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode != 0:
        partial.unlink(missing_ok=True)
        raise BuildError(f"{shlex.join(command)}\n{done.stderr[-4000:]}")
    partial.replace(target)  # whole or not at all: a running process keeps the old one


def _zig_names(compiler: Sequence[str], flags: Sequence[str]) -> list[str]:
    """Zig writes x86-64-v3 as x86_64_v3, and adds checks of its own unless told not to."""
    if tuple(compiler[1:]) != ("-m", COMPILER_PACKAGE, "cc"):
        return list(flags)
    machine = platform.machine().lower()
    renamed = [
        "-mcpu=" + flag.removeprefix("-march=").replace("-", "_")
        if flag.startswith("-march=x86")
        else flag
        for flag in flags
        if not flag.startswith("-march=armv8")
    ]
    # An old glibc: the wheel runs where it was not built.
    return [*renamed, "-fno-sanitize=undefined", "-target", f"{machine}-linux-gnu.2.17"]


def build(*, force: bool = False) -> list[Path]:
    """Makes what is missing or older than its sources; gives the libraries' files.

    Raises:
        BuildError: no compiler, an unknown kind of machine, or the compiler failed.
    """
    wanted = variants()
    if not wanted or sys.platform != "linux":
        raise BuildError(f"there are no kernels for {sys.platform} on {platform.machine()}")
    targets = [LIBRARIES / variant.file_name for variant in wanted]
    stamp = LIBRARIES / "made-from"
    made = stamp.read_text(encoding="utf-8") if stamp.exists() else ""
    if not force and made == fingerprint() and all(t.exists() for t in targets):
        return targets
    compiler = find_compiler()
    if compiler is None:
        raise BuildError(f"no C compiler: set CC, or install cc, gcc, clang or {COMPILER_PACKAGE}")
    LIBRARIES.mkdir(exist_ok=True)
    stamp.unlink(missing_ok=True)
    for variant, target in zip(wanted, targets, strict=True):
        compile_library(compiler, variant, target)
    stamp.write_text(fingerprint(), encoding="utf-8")
    return targets


def main() -> int:
    """Builds, or prints the package that brings a compiler where one is needed."""
    parser = argparse.ArgumentParser(description="Compiles the kernels.")
    parser.add_argument("--force", action="store_true", help="also what is up to date")
    parser.add_argument(
        "--requirement",
        action="store_true",
        help="only print the package that brings a compiler, if none is here",
    )
    arguments = parser.parse_args()
    if arguments.requirement:
        sys.stdout.write("" if find_compiler() else f"{COMPILER_PACKAGE}\n")
        return 0
    try:
        made = build(force=arguments.force)
    except BuildError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.writelines(f"{path}\n" for path in made)
    return 0


if __name__ == "__main__":
    sys.exit(main())
