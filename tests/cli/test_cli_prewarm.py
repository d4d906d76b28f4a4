"""Compiling ahead: every kernel of the package is found."""

from __future__ import annotations

import importlib
import inspect
import pkgutil

import omtwarp
from omtwarp.device.prewarm import kernel_modules


def test_every_module_with_kernels_is_found():
    """Modules found by reading files are those whose imported module holds kernels."""
    from omtwarp.device.start import wp

    holding = set()
    for module in pkgutil.walk_packages(omtwarp.__path__, "omtwarp."):
        if module.name.rpartition(".")[2] == "__main__":
            continue
        members = inspect.getmembers(importlib.import_module(module.name))
        holding |= {value.module.name for _, value in members if isinstance(value, wp.Kernel)}
    own = {name for name in holding if name.startswith("omtwarp")}
    assert own and own == set(kernel_modules())
