"""Checks of the options that layers and functions are made with: what is wrong is named when it is given.

An option that is a plain value (a temperature, a number of neighbours) is known before any data are; a layer checks it
when it is made. A wrong value is a ``ValueError``, a wrong type a ``TypeError``; both say what is allowed.
"""

from collections.abc import Iterable
from math import isfinite
from numbers import Integral, Real

import numpy as np

__all__ = ["require_call", "require_choice", "require_counts", "require_flag", "require_number", "require_whole"]


def require_number(
    name: str, value: object, least: float | None = None, above: float | None = None, below: float | None = None
) -> None:
    """Raise unless an option is a finite number inside its bounds.

    Args:
        name: of the option, for the message.
        value: what was given.
        least: the smallest number allowed.
        above: numbers must be larger.
        below: numbers must be smaller.

    Raises:
        ValueError: it is outside, infinite or NaN; ``TypeError`` if it is no number.

    Example:
        >>> require_number("tau", 0.2, above=0)
        >>> require_number("tau", -1, above=0)
        Traceback (most recent call last):
        ValueError: tau: -1 given, expected a positive number
    """
    allowed = "a positive number" if above == 0 else "a number" + (f" above {above:g}" if above is not None else "")
    if least is not None:
        allowed += f" from {least:g}" + (" on" if below is None else "")
    if below is not None:
        allowed += f" below {below:g}"
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Real):
        raise TypeError(f"{name}: {_shown(value)} given, expected {allowed}")
    number = float(value)
    inside = (least is None or number >= least) and (above is None or number > above)
    if not (isfinite(number) and inside and (below is None or number < below)):
        raise ValueError(f"{name}: {value} given, expected {allowed}")


def require_whole(name: str, value: object, least: int | None = 1, optional: bool = False) -> None:
    """Raise unless an option is a whole number.

    Args:
        name: of the option, for the message.
        value: what was given.
        least: the smallest number allowed; None: any.
        optional: None is allowed, too.

    Raises:
        ValueError: it is smaller; ``TypeError`` if it is no whole number.

    Example:
        >>> require_whole("k", None, optional=True)
        >>> require_whole("k", 0, optional=True)
        Traceback (most recent call last):
        ValueError: k: 0 given, expected a whole number from 1 on or None
    """
    if value is None and optional:
        return
    allowed = "a whole number" + ("" if least is None else f" from {least} on") + (" or None" if optional else "")
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, Integral):
        raise TypeError(f"{name}: {_shown(value)} given, expected {allowed}")
    if least is not None and int(value) < least:
        raise ValueError(f"{name}: {value} given, expected {allowed}")


def require_counts(name: str, values: object, least: int = 1) -> tuple[int, ...]:
    """Several whole numbers, as a tuple; raises like :func:`require_whole`.

    Example:
        >>> require_counts("sizes", [20, 40])
        (20, 40)
    """
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise TypeError(f"{name}: {_shown(values)} given, expected several whole numbers from {least} on")
    found = tuple(values)
    for place, value in enumerate(found):
        require_whole(f"{name}[{place}]", value, least)
    return tuple(int(value) for value in found)


def require_choice(name: str, value: object, allowed: Iterable[str]) -> None:
    """Raise ``ValueError`` unless an option is one of some names.

    Example:
        >>> require_choice("kind", "cosine", ("dot", "distance"))
        Traceback (most recent call last):
        ValueError: kind: 'cosine' given, allowed are dot, distance
    """
    names = tuple(allowed)
    if not isinstance(value, str) or value not in names:
        raise ValueError(f"{name}: {value!r} given, allowed are {', '.join(names)}")


def require_flag(name: str, value: object) -> None:
    """Raise ``TypeError`` unless an option is True or False: an option of another place does not become a yes.

    Example:
        >>> require_flag("learn_tau", 10)
        Traceback (most recent call last):
        TypeError: learn_tau: 10 (int) given, expected True or False
    """
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name}: {_shown(value)} given, expected True or False")


def require_call(name: str, value: object) -> None:
    """Raise ``TypeError`` unless an option is a function (something to be called) or None.

    Example:
        >>> require_call("last_activation", "relu")
        Traceback (most recent call last):
        TypeError: last_activation: 'relu' (str) given, expected a function or None
    """
    if value is not None and not callable(value):
        raise TypeError(f"{name}: {_shown(value)} given, expected a function or None")


def _shown(value: object) -> str:
    text = repr(value)
    return f"{text if len(text) <= 40 else text[:37] + '...'} ({type(value).__name__})"
