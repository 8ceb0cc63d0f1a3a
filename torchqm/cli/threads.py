"""How many threads the numerical libraries use; to be said before they are loaded."""

import argparse
import os
import sys

__all__ = ["THREAD_VARIABLES", "add_threads", "limit_to_one_thread", "set_threads"]

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What the numerical libraries read when they are loaded."""


def add_threads(parser: argparse.ArgumentParser, default: int | None = None) -> None:
    """The option ``--threads``."""
    text = "of the numerical libraries (default: " + ("all cores" if default is None else str(default)) + ")"
    parser.add_argument("--threads", type=_count, metavar="N", default=None, help=text)
    parser.set_defaults(default_threads=default)


def set_threads(given: int | None, default: int | None) -> None:
    """Tell libraries that are not loaded yet: what was given, else what the environment says, else the default.

    Idle threads are also told to sleep: several libraries have a pool each, and pools that spin while they wait take
    the cores from one another (on a busy machine of two cores the demo took 190 s instead of 72 s).
    """
    if "numpy" in sys.modules:  # called from Python: the caller decides
        return
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for name in THREAD_VARIABLES:
        if given is not None:
            os.environ[name] = str(given)
        elif default is not None:
            os.environ.setdefault(name, str(default))


def limit_to_one_thread() -> None:
    """One thread from now on, for libraries that are loaded already (in the calling thread) and for those to come."""
    from threadpoolctl import threadpool_limits

    for name in THREAD_VARIABLES:
        os.environ[name] = "1"
    threadpool_limits(1)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: at least 1 thread is needed")
    return value
