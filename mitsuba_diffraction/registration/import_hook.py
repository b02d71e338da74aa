"""Registration of the plugins as soon as Mitsuba is imported, without importing it.

Precomputation, inspection and the readers do not need Mitsuba, which takes longer to import than they take to run.
"""

from __future__ import annotations

import importlib.abc
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any


def register() -> None:
    """Register for Mitsuba's current and later variants; now, or when Mitsuba is imported."""
    if (mitsuba := sys.modules.get("mitsuba")) is not None:
        _watch(mitsuba)
    elif not any(isinstance(finder, _MitsubaFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _MitsubaFinder())


def _watch(mitsuba: ModuleType) -> None:
    mitsuba.detail.add_variant_callback(_on_variant_change)
    if mitsuba.variant() is not None:
        from . import plugins  # noqa: F401


def _on_variant_change(old: str | None, new: str | None) -> None:
    # Imported only now, as the module that imports Mitsuba may be one that the plugins need.
    if new is None:
        return
    loaded = f"{__package__}.plugins" in sys.modules
    from . import plugins

    if loaded:
        plugins.register_plugins(new)


class _MitsubaFinder(importlib.abc.MetaPathFinder):
    """Selects LLVM before Dr.Jit is imported and registers the plugins after Mitsuba has been imported.

    It stays on `sys.meta_path` until then, as `importlib.util.find_spec` searches without importing.
    """

    _searching = False

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name in ("drjit", "mitsuba") and "drjit" not in sys.modules:
            from ..variants import choose_libllvm

            choose_libllvm()
        if name != "mitsuba" or self._searching:
            return None
        self._searching = True
        try:
            spec = importlib.util.find_spec(name)
        finally:
            self._searching = False
        if spec is None or spec.loader is None:
            return None
        loader: Any = spec.loader
        execute = loader.exec_module

        def execute_and_register(module: ModuleType) -> None:
            try:
                execute(module)
            except NameError as error:  # Dr.Jit's report of a library that is missing fails with it
                if not isinstance(missing := error.__context__, ImportError):
                    raise
                hint = " (Debian: apt install libatomic1)" if "libatomic" in str(missing) else ""
                raise ImportError(f"Dr.Jit cannot be loaded: {missing}{hint}") from error
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            _watch(sys.modules["mitsuba"])

        loader.exec_module = execute_and_register
        return spec
