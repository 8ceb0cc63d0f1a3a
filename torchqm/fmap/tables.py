"""Checks of tables of vertex maps and of large tensors of weights; they say what is allowed."""

import torch
from torch import Tensor

from torchqm.checks import Sizes, enabled, require_finite, require_ids, require_mask, require_nonnegative, require_real

__all__ = ["check_group", "require_weights"]


def check_group(name: str, group: Tensor, mask: Tensor | None, mask_name: str = "group_mask") -> None:
    """A table of vertex maps: ids in range, row 0 the identity and real.

    Raises:
        ValueError: it is not.
    """
    sizes = Sizes()
    sizes.bind(name, group, "... G V")
    if mask is not None:
        sizes.bind(mask_name, mask, "... G")
        require_mask(mask_name, mask)
    require_ids(name, group, sizes["V"])
    if not enabled():
        return
    if not bool((group[..., 0, :] == torch.arange(sizes["V"], device=group.device)).all()):
        raise ValueError(f"{name}: row 0 must be the identity; the table is (..., G, V), one row an element")
    if mask is not None and not bool(mask[..., 0].all()):
        raise ValueError(f"{mask_name}: element 0, the identity, is real in each shape")


def require_weights(name: str, values: Tensor, logarithms: bool = False) -> None:
    """:func:`torchqm.checks.require_nonnegative` for large tensors: one pass and no copy where nothing is wrong.

    With ``logarithms`` negative values and minus infinity are allowed.
    """
    require_real(name, values)
    if not enabled() or not values.numel():
        return
    least, most = torch.aminmax(values.detach())  # NaN comes through
    if not bool(most < float("inf")):
        require_finite(name, values.masked_fill(values == -float("inf"), 0.0) if logarithms else values)
    if not logarithms and not bool(least >= 0):
        require_nonnegative(name, values)
