"""The suite checks annotations at run time; a user gets the function's own ValueError, and this is how to see it."""

import inspect
from collections.abc import Callable
from typing import Any


def unchecked(fn: Callable[..., Any]) -> Callable[..., Any]:
    """The function without the run-time check of its annotations."""
    return inspect.unwrap(fn)
