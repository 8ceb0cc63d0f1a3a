"""An operator of torch in Python whose first call does not load torch's compiler."""

import sys
from collections.abc import Callable
from functools import wraps
from typing import Any

import torch

__all__ = ["operator"]

_LIBRARY = torch.library.Library("torchqm", "FRAGMENT")  # what it defines lives as long as it


def operator(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make a function ``torch.ops.torchqm.<name>``; its types give the schema, and it changes none of its arguments.

    As :func:`torch.library.custom_op`, which keeps ``torch.compile`` out of the function with a decorator that loads
    ``torch._dynamo`` and sympy at the first call: more than a second in each process, compiled or not. Here they
    are asked to keep out only if something else has loaded them; nobody can be tracing before that. As there, a
    backward pass through the operator itself is an error; a :class:`torch.autograd.Function` around it may have one.

    Args:
        name: of the operator. ``torch.library.register_fake`` and ``register_vmap`` take ``"torchqm::<name>"``.

    Returns:
        A decorator; it gives the function back as it is.
    """

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        schema = torch.library.infer_schema(function, mutates_args=())
        _LIBRARY.define(name + schema, tags=torch.Tag.pt2_compliant_tag)
        _LIBRARY.impl(name, _untraced(function), "CompositeExplicitAutograd")

        def refuse(*_: Any) -> None:  # without it the gradient would be that of a chance operation inside
            raise RuntimeError(f"torch.ops.torchqm.{name} has no derivative")

        torch.library.register_autograd(f"torchqm::{name}", refuse, lib=_LIBRARY)
        return function

    return register


def _untraced(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, run and never traced by ``torch.compile``."""
    disabled: Callable[..., Any] | None = None

    @wraps(function)
    def call(*args: Any) -> Any:
        nonlocal disabled
        if "torch._dynamo" not in sys.modules:
            return function(*args)
        if disabled is None:
            disabled = torch.compiler.disable(function)
        return disabled(*args)

    return call
