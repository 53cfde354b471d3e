"""Kernels are compiled where they can be, and used only where they fit; else torch works."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch

from trajectron_model.kernels import build, in_use, kernels, loading
from trajectron_model.kernels.threads import share, torch_alone

ROOT = Path(__file__).parents[2]

needs_kernels = pytest.mark.skipif(kernels() is None, reason=in_use())


def asked_with(switch: str) -> str:
    """What a new process says is in use."""
    code = "from trajectron_model import kernels; print(kernels.in_use())"
    ran = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, loading.SWITCH: switch, "PYTHONPATH": str(ROOT / "model")},
        capture_output=True,
        text=True,
        check=True,
    )
    return ran.stdout.strip()


def test_where_there_is_a_compiler_make_install_has_compiled_kernels() -> None:
    if not build.variants() or build.find_compiler() is None:
        pytest.skip("no kernels for this machine, or no compiler")
    library = kernels()
    assert library is not None, in_use()
    assert library.variant == in_use()
    assert library.lanes >= 4


@needs_kernels
def test_the_switch_turns_them_off_and_says_so() -> None:
    assert asked_with("off") == "torch: TRAJECTRON_KERNELS=off"
    assert asked_with("auto") == in_use()


@needs_kernels
@pytest.mark.skipif(platform.machine() != "x86_64", reason="several sets on x86-64 only")
def test_a_processor_gets_the_widest_instruction_set_that_it_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names: dict[str, object] = {}
    for variant in build.variants():
        monkeypatch.setattr(loading, "_processor_flags", lambda v=variant: v.needs)
        monkeypatch.setattr(loading, "_load", lambda _path, name: name)
        names[variant.name] = loading._found.__wrapped__()
    assert names == {variant.name: variant.name for variant in build.variants()}
    monkeypatch.setattr(loading, "_processor_flags", frozenset)
    found = loading._found.__wrapped__()
    assert isinstance(found, loading.Unavailable)
    assert "none for this processor" in found.reason


@needs_kernels
def test_a_library_older_than_its_sources_is_not_called(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "fingerprint", lambda: "of changed sources")
    found = loading._found.__wrapped__()
    assert isinstance(found, loading.Unavailable)
    assert "older than its sources" in found.reason


def test_a_broken_library_is_not_called(tmp_path: Path) -> None:
    path = tmp_path / "trajectron-broken.so"
    path.write_bytes(b"no library")
    found = asked_with(str(path))
    assert found.startswith("torch: trajectron-broken.so cannot be loaded")


def test_what_the_compiler_says_is_passed_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = build.find_compiler()
    if compiler is None or not build.variants():
        pytest.skip("no compiler")
    (tmp_path / "wrong.c").write_text("int f(void) { return missing; }")
    monkeypatch.setattr(build, "SOURCES", tmp_path)
    with pytest.raises(build.BuildError, match="missing"):
        build.compile_library(compiler, build.variants()[-1], tmp_path / "wrong.so")
    assert not list(tmp_path.glob("*.so*")) + list(tmp_path.glob("*partial*"))


@needs_kernels
def test_the_wheel_carries_them_and_names_its_platform(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.endswith(f"-py3-none-linux_{platform.machine()}.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    folder = "trajectron_model/kernels/"
    assert {f"{folder}lib/{v.file_name}" for v in build.variants()} <= names
    # Its fingerprint is compared with the sources: they are in the wheel too.
    assert {folder + path.name for path in build.sources()} <= names


@needs_kernels
def test_torch_is_kept_to_one_thread_around_kernels_and_set_back() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        shares: list[tuple[int, int]] = []
        with torch_alone():
            assert torch.get_num_threads() == 1
            share(10, 1, lambda first, last: shares.append((first, last)))
        assert torch.get_num_threads() == 3
        assert sorted(shares) == [(0, 3), (3, 6), (6, 10)]
    finally:
        torch.set_num_threads(before)


@needs_kernels
def test_a_fault_in_any_part_of_shared_work_is_told() -> None:
    def work(first: int, _last: int) -> None:
        if first > 0:
            raise RuntimeError("a part failed")

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        with pytest.raises(RuntimeError, match="a part failed"):
            share(10, 1, work)
    finally:
        torch.set_num_threads(before)
