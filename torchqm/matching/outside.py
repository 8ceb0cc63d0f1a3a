"""Descriptors from outside in the place of wave kernel signatures: learned ones, or whatever a caller has."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.threads import threads_as_before
from torchqm.matching.parameters import MatchError
from torchqm.matching.shape import PreparedShape

__all__ = ["Descriptors", "describe_pair"]

Descriptors = Callable[[PreparedShape], Float[Tensor, "V C"]]
"""Makes the descriptors of one shape: ``(V, C)``, a row for each vertex of its mesh, comparable between shapes."""


def describe_pair(
    x: PreparedShape, y: PreparedShape, descriptors: Descriptors
) -> tuple[Float[Tensor, "Vx C"], Float[Tensor, "Vy C"]]:
    """The descriptors of two shapes in the precision of their bases, checked.

    They need not be symmetric: matching reads them through bases of symmetric functions, which hold nothing else.

    Args:
        x: the source.
        y: the target.
        descriptors: called with each of the two, with the threads that the caller has.

    Raises:
        MatchError: values that are not finite, no ``(V, C)`` table, or another C on the other shape.
    """
    found = []
    for shape in (x, y):
        with threads_as_before():
            values = torch.as_tensor(descriptors(shape)).detach()
        given = f"descriptors of {shape.mesh.label}: {values.dtype} of shape {tuple(values.shape)}"
        if values.ndim != 2 or values.shape[0] != shape.n_verts or not values.shape[1]:
            raise MatchError(f"{given}; expected ({shape.n_verts}, C), a row for each vertex and one column at least")
        if not values.is_floating_point():
            raise MatchError(f"{given}; expected real numbers")
        if not bool(values.isfinite().all()):
            raise MatchError(f"{given}; {int((~values.isfinite()).sum())} of them are not finite")
        found.append(values.to(shape.basis.evecs))
    if found[0].shape[1] != found[1].shape[1]:
        names = f"{x.mesh.label} has {found[0].shape[1]} and {y.mesh.label} {found[1].shape[1]}"
        raise MatchError(f"descriptors: {names}; the same columns are needed on both")
    return found[0], found[1]
