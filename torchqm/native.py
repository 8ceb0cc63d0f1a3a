"""Finds what was built from our C files, if it was, and lets it share torch's threads.

``pip install`` builds them where there is a C compiler with GCC's vector types: GCC, or Clang, whose code for the rows
of functional maps takes twice as long. Without them other libraries do the same work in several times as long.
``torchqm --version`` says which are there. After a change of a C file they have to be installed anew.
"""

import ctypes
import os
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

__all__ = ["LIBRARIES", "available", "library"]

LIBRARIES = ("fmap/_rows", "spectral/_ldl", "spectral/_projections")

_PACKAGE = Path(__file__).parent
_ABI = 1  # of native.h
# OpenMP's function, where torch has loaded it; its threads are then torch's own.
_TEAM = "GOMP_parallel"


def available() -> list[str]:
    """Those of :data:`LIBRARIES` that are built and of use on this processor."""
    return [name for name in LIBRARIES if _load(name) is not None]


@cache
def library(name: str) -> ctypes.CDLL | None:
    """One of :data:`LIBRARIES`; None where it was not built, or where this processor is better off without it.

    To be called when torch is loaded, so that they use its threads.
    """
    loaded = _load(name)
    if loaded is not None:
        team = getattr(ctypes.CDLL(None), _TEAM, None) if os.name == "posix" else None
        loaded.use_team(ctypes.cast(team, ctypes.c_void_p) if team else None)
        loaded.large_pages.argtypes = [ctypes.c_void_p, ctypes.c_int64]
    return loaded


def _load(name: str) -> ctypes.CDLL | None:
    for suffix in EXTENSION_SUFFIXES:
        path = _PACKAGE / f"{name}{suffix}"
        if path.is_file():
            try:
                loaded = ctypes.CDLL(str(path))
            except OSError:  # of another system
                continue
            if not hasattr(loaded, "abi") or loaded.abi() != _ABI:  # built before the Python files changed
                return None
            return loaded if loaded.fast() else None
    return None
