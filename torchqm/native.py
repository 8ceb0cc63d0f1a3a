"""Finds what was built from our C files, if it was, and lets it share torch's threads."""

import ctypes
import os
from functools import cache
from importlib.util import find_spec

__all__ = ["library"]

# OpenMP's function, where torch has loaded it; its threads are then torch's own.
_TEAM = "GOMP_parallel"


@cache
def library(name: str) -> ctypes.CDLL | None:
    """A library of this package; None where it was not built, or where this processor is better off without it.

    Built by ``pip install`` where there is a C compiler with GCC's vector types.

    Example:
        >>> library("torchqm.fmap.no_such_library") is None
        True
    """
    found = find_spec(name)
    if found is None or found.origin is None:
        return None
    try:
        loaded = ctypes.CDLL(found.origin)
    except OSError:  # of another system
        return None
    team = getattr(ctypes.CDLL(None), _TEAM, None) if os.name == "posix" else None
    loaded.use_team(ctypes.cast(team, ctypes.c_void_p) if team else None)
    loaded.large_pages.argtypes = [ctypes.c_void_p, ctypes.c_int64]
    return loaded if loaded.fast() else None
