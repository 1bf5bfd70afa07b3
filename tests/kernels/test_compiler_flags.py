"""All kernels are compiled with the same flags, so that a process reads Warp's headers once."""

from __future__ import annotations

import importlib
import pkgutil

import warp as wp

import dase.kernels
from dase.kernels.compiler_flags import CPU_FLAGS


def test_no_module_has_flags_of_its_own():
    names = [one.name for one in pkgutil.iter_modules(dase.kernels.__path__)]
    modules = [importlib.import_module(f"dase.kernels.{name}") for name in names]
    kernels = [v for module in modules for v in vars(module).values() if isinstance(v, wp.Kernel)]
    assert len(kernels) > 30
    others = {k.key for k in kernels if k.module.options["cpu_compiler_flags"] != CPU_FLAGS}
    assert not others
