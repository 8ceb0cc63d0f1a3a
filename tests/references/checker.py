"""The run-time type checker of the test suite: beartype, where an int is a float as it is for mypy (PEP 484)."""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked(fn: Callable[..., Any]) -> Callable[..., Any]:
    """The function with checks of its annotations.

    jaxtyping asks for two checkers of each function: one that is called with the arguments, and one that is called with
    arguments and result after the first. The second need not check the arguments once more: the sizes of their axes
    are remembered. That saves a tenth of the time of the numerical tests.
    """
    hints = fn.__annotations__
    if hints.get("return", Any) is not Any:  # of the first it is Any
        fn.__annotations__ = {"return": hints["return"]}
    return _beartype(fn)
