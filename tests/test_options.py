"""torchqm.options: what is allowed passes, all else is named with what was given and what is allowed."""

from fractions import Fraction
from functools import partial

import numpy as np
import pytest
import torch

from torchqm.options import (
    require_call,
    require_choice,
    require_counts,
    require_flag,
    require_number,
    require_whole,
)


@pytest.mark.parametrize("value", [1, 0.5, np.float32(0.1), np.int64(3), Fraction(1, 3), 1e-300])
def test_numbers_of_any_kind(value):
    require_number("t", value, above=0)
    require_number("t", value, least=0)


@pytest.mark.parametrize(
    ("value", "bounds", "message"),
    [
        (0, {"above": 0}, "t: 0 given, expected a positive number"),
        (float("inf"), {"above": 0}, "t: inf given, expected a positive number"),
        (float("nan"), {"least": 0}, "t: nan given, expected a number from 0 on"),
        (-0.1, {"least": 0}, "t: -0.1 given, expected a number from 0 on"),
        (1, {"least": 0, "below": 1}, "t: 1 given, expected a number from 0 below 1"),
        (1.0, {"above": 0, "below": 1}, "t: 1.0 given, expected a positive number below 1"),
        (2, {"above": 3}, "t: 2 given, expected a number above 3"),
        (float("inf"), {}, "t: inf given, expected a number"),
    ],
)
def test_numbers_out_of_bounds(value, bounds, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        require_number("t", value, **bounds)


@pytest.mark.parametrize("value", ["0.2", None, True, np.True_, torch.tensor(0.2), 1j, [0.2]])
def test_what_is_no_number(value):
    with pytest.raises(TypeError, match=rf"^t: .* \({type(value).__name__}\) given, expected a positive number$"):
        require_number("t", value, above=0)


def test_whole_numbers():
    for value in (1, np.int32(7), 10**20):
        require_whole("k", value)
    require_whole("k", -3, least=None)
    for value, least, optional, message in (
        (0, 1, False, "k: 0 given, expected a whole number from 1 on"),
        (-1, 0, True, "k: -1 given, expected a whole number from 0 on or None"),
    ):
        with pytest.raises(ValueError, match=f"^{message}$"):
            require_whole("k", value, least, optional)
    for value in (2.0, "2", True, None):
        with pytest.raises(TypeError, match=r"^k: .* given, expected a whole number from 1 on$"):
            require_whole("k", value)
    with pytest.raises(TypeError, match=r"^k: 2.5 \(float\) given, expected a whole number$"):
        require_whole("k", 2.5, least=None)


def test_several_whole_numbers():
    assert require_counts("sizes", np.array([3, 5])) == (3, 5)
    assert require_counts("sizes", ()) == ()
    with pytest.raises(ValueError, match=r"^sizes\[1\]: 0 given, expected a whole number from 1 on$"):
        require_counts("sizes", [4, 0])
    for value in (20, "20", None):
        with pytest.raises(TypeError, match=r"^sizes: .* given, expected several whole numbers from 1 on$"):
            require_counts("sizes", value)


def test_names_flags_and_functions():
    require_choice("kind", "dot", {"dot": 1})
    for value in ("cosine", None, ["dot"]):
        with pytest.raises(ValueError, match=r"^kind: .* given, allowed are dot, distance$"):
            require_choice("kind", value, ("dot", "distance"))
    for value in (True, False, np.False_):
        require_flag("hard", value)
    for value in (1, 0, None, "yes"):
        with pytest.raises(TypeError, match=r"^hard: .* given, expected True or False$"):
            require_flag("hard", value)
    require_call("f", partial(torch.softmax, dim=-1))
    require_call("f", None)
    with pytest.raises(TypeError, match=r"^f: \[1, 1, .*\.\.\. \(list\) given, expected a function or None$"):
        require_call("f", [1] * 50)
