"""The build hook: compiles the kernels into the package before it is packed or linked.

Without a compiler, and without the package that brings one, the wheel is pure Python and
torch does the work.
"""

from __future__ import annotations

import importlib.util
import sys
import sysconfig
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_KERNELS = Path("model/trajectron_model/kernels")


class KernelsHook(BuildHookInterface[Any]):
    """Adds the libraries to a wheel and names its platform; an editable install links to them."""

    def dependencies(self) -> list[str]:
        """What an isolated build needs on top: a compiler, if the system has none."""
        build = self._builder()
        return [] if build.find_compiler() else [build.COMPILER_PACKAGE]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by hatchling with version ``standard`` or ``editable``."""
        build = self._builder()
        try:
            made = build.build()
        except build.BuildError as error:
            self.app.display_warning(f"no kernels, torch does the work: {error}")
            return
        if version == "standard":
            build_data["pure_python"] = False
            platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
            build_data["tag"] = f"py3-none-{platform}"
            # Git ignores them, and hatchling with it, unless told.
            build_data["artifacts"] += [f"/{_KERNELS}/lib/{path.name}" for path in made]

    def _builder(self) -> ModuleType:
        """The package's own build file, loaded without the package (and its torch)."""
        path = Path(self.root) / _KERNELS / "build.py"
        spec = importlib.util.spec_from_file_location("trajectron_kernels_build", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        return module
