"""The projection onto symmetric functions in a truncated basis, from any kind of symmetry: batched and differentiable.

A symmetry is a table of vertex maps, functional matrices, or a soft self-map that carries gradients. Of each comes
``P = mean_g Phi^T A Pi_g Phi``, a ``(..., K, K)`` matrix; :mod:`torchqm.symmetry.split` makes bases of it.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.checks import Sizes, enabled, require_finite, require_ids, require_mask, require_nonnegative
from torchqm.spectral.soft_map import SoftMap

__all__ = ["projection_matrices"]


def projection_matrices(
    evecs: Float[Tensor, "*B V K"],
    mass: Float[Tensor, "*B V"],
    *,
    group: Int[Tensor, "*B G V"] | None = None,
    fmaps: Float[Tensor, "..."] | None = None,
    soft_map: "SoftMap | Float[Tensor, '*B V V'] | None" = None,
    group_mask: Bool[Tensor, "*B G"] | None = None,
    verts_mask: Bool[Tensor, "*B V"] | None = None,
    evals_mask: Bool[Tensor, "*B K"] | None = None,
) -> Float[Tensor, "*B K K"]:
    """``P = mean_g Phi^T A Phi[g]``, or ``mean_g C_g``, or ``(I + Phi^T A Pi Phi) / 2``: pi+ written in the basis.

    Exactly one of ``group``, ``fmaps`` and ``soft_map`` is given. Padding (false in a mask) takes no part, whatever it
    holds; rows and columns of padded functions are 0.

    Args:
        evecs: ``(..., V, K)`` basis, orthonormal in ``mass``.
        mass: ``(..., V)`` vertex areas.
        group: ``(..., G, V)`` vertex maps, row 0 the identity, as in :class:`torchqm.symmetry.SymmetryGroup`.
        fmaps: ``(..., G, K, K)`` functional matrices of all elements of a group (the identity too, if it is one), or
            ``(..., K, K)`` that of one reflection: then ``P = (I + C) / 2``.
        soft_map: a reflection as a soft map of the shape to itself, sparse or dense ``(..., V, V)``, rows of sum 1.
        group_mask: ``(..., G)`` which elements of ``group`` or ``fmaps`` are real.
        verts_mask: ``(..., V)`` which vertices are.
        evals_mask: ``(..., K)`` which functions are.

    Returns:
        ``(..., K, K)``, with gradients to ``evecs``, ``mass`` and the symmetry. Not symmetric in general.

    Raises:
        ValueError: none or several symmetries are given, sizes do not fit, an id is out of range or goes to padding,
            row 0 is not the identity, ``mass`` is negative, a number is not finite, or a mask has a row without a true
            element.

    Example:
        >>> evecs = torch.tensor([[1.0, 1.0], [1.0, -1.0]]) / 2**0.5
        >>> swap = torch.tensor([[0, 1], [1, 0]])
        >>> projection_matrices(evecs, torch.ones(2), group=swap).abs().round(decimals=5).tolist()
        [[1.0, 0.0], [0.0, 0.0]]

    References:
        Paper, section 3, equation 1; Ren et al. 2019 for self-maps as functional matrices.
    """
    sizes = check_basis(evecs, mass, verts_mask, evals_mask)
    check_symmetry(sizes, group, fmaps, soft_map, group_mask, verts_mask)
    evecs, mass = without_padding(evecs, mass, verts_mask, evals_mask)
    return project(evecs, mass, group, fmaps, soft_map, group_mask, evals_mask)


def project(
    evecs: Tensor,
    mass: Tensor,
    group: Tensor | None,
    fmaps: Tensor | None,
    soft_map: SoftMap | Tensor | None,
    group_mask: Tensor | None,
    evals_mask: Tensor | None,
) -> Tensor:
    """:func:`projection_matrices` of arguments that are checked and free of padding."""
    if group is not None:
        count = group.shape[-2] if group_mask is None else group_mask.sum(-1)[..., None, None]
        return _inner_products(evecs, _sum_over_maps(evecs, group.long(), group_mask), mass) / count
    if soft_map is not None:
        pulled = soft_map.apply(evecs) if isinstance(soft_map, SoftMap) else soft_map @ evecs
        fmaps = _inner_products(evecs, pulled, mass)
    elif fmaps is None:
        raise ValueError("no symmetry is given")
    if fmaps.ndim > evecs.ndim:
        projection = (fmaps * _shares(group_mask, fmaps)[..., None, None]).sum(-3)
    else:
        projection = (torch.eye(evecs.shape[-1], dtype=evecs.dtype, device=evecs.device) + fmaps) / 2
    return projection if evals_mask is None else torch.where(pairs(evals_mask), projection, 0.0)


def pairs(mask: Bool[Tensor, "*B K"]) -> Bool[Tensor, "*B K K"]:
    """Where both row and column are real."""
    return mask[..., :, None] & mask[..., None, :]


def without_padding(
    evecs: Tensor, mass: Tensor, verts_mask: Tensor | None, evals_mask: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Zeros where the masks say padding, so that products come out as for each shape alone."""
    if verts_mask is not None:
        evecs, mass = torch.where(verts_mask[..., None], evecs, 0.0), torch.where(verts_mask, mass, 0.0)
    if evals_mask is not None:
        evecs = torch.where(evals_mask[..., None, :], evecs, 0.0)
    return evecs, mass


def check_basis(evecs: Tensor, mass: Tensor, verts_mask: Tensor | None, evals_mask: Tensor | None) -> Sizes:
    """Sizes of a batch of bases, after checks of sizes and values."""
    sizes = Sizes()
    sizes.bind("evecs", evecs, "... V K")
    sizes.bind("mass", mass, "... V")
    if not sizes["K"]:
        raise ValueError(f"evecs: shape {tuple(evecs.shape)} given, expected at least one function")
    for name, mask, dims in (("verts_mask", verts_mask, "... V"), ("evals_mask", evals_mask, "... K")):
        if mask is not None:
            sizes.bind(name, mask, dims)
            require_mask(name, mask)
    require_finite("evecs", evecs)
    require_nonnegative("mass", mass)
    require_mask("mass > 0", mass > 0)
    return sizes


def check_symmetry(
    sizes: Sizes,
    group: Tensor | None,
    fmaps: Tensor | None,
    soft_map: SoftMap | Tensor | None,
    group_mask: Tensor | None,
    verts_mask: Tensor | None,
) -> None:
    """Checks of a symmetry against the sizes of a batch of bases."""
    given = {"group": group, "fmaps": fmaps, "soft_map": soft_map}
    names = [name for name, value in given.items() if value is not None]
    if len(names) != 1:
        raise ValueError(f"the symmetry is given by {names or 'nothing'}: exactly one of {', '.join(given)} is allowed")
    if group is not None:
        sizes.bind("group", group, "... G V", any_dtype=True)
        require_ids("group", group, sizes["V"])
        if enabled():
            if verts_mask is not None:
                _stays_real("group", group, verts_mask)
            own = torch.arange(sizes["V"], device=group.device)
            moved = group[..., 0, :] != own
            if bool((moved if verts_mask is None else moved & verts_mask).any()):
                raise ValueError("group: row 0 must be the identity, in each sample")
    elif fmaps is not None:
        many = fmaps.ndim == len(sizes.leading) + 3
        sizes.bind("fmaps", fmaps, "... G K K" if many else "... K K")
        require_finite("fmaps", fmaps)
    elif isinstance(soft_map, SoftMap):
        sizes.bind("soft_map.indices", soft_map.indices, "... V k")
        sizes.bind("soft_map.weights", soft_map.weights, "... V k")
        if soft_map.n_targets != sizes["V"]:
            raise ValueError(
                f"soft_map: goes to {soft_map.n_targets} vertices, but the shape has {sizes['V']}; a self-map is needed"
            )
        require_ids("soft_map.indices", soft_map.indices, sizes["V"])
        require_finite("soft_map.weights", soft_map.weights)
    elif soft_map is not None:
        sizes.bind("soft_map", soft_map, "... V V")
        require_finite("soft_map", soft_map)
    if group_mask is not None:
        if group is None and (fmaps is None or fmaps.ndim != len(sizes.leading) + 3):
            raise ValueError("group_mask: given, but there is no table of maps or matrices that it could belong to")
        sizes.bind("group_mask", group_mask, "... G")
        require_mask("group_mask", group_mask)
        if group is not None and enabled() and not bool(group_mask[..., 0].all()):
            raise ValueError("group_mask: element 0, the identity, must be real (true) in each sample")


def _stays_real(name: str, ids: Tensor, verts_mask: Tensor) -> None:
    """Raise where a real vertex goes to a padded one."""
    mask = verts_mask[..., None, :].expand(ids.shape)
    lost = mask & ~torch.gather(mask, -1, ids)
    if bool(lost.any()):
        first = tuple(int(i) for i in lost.nonzero()[0])
        raise ValueError(f"{name}: a real vertex goes to a padded one, the first at {first}")


def _shares(mask: Tensor | None, fmaps: Tensor) -> Tensor:
    """What each element counts in a mean over the real ones: ``(..., G)`` with sum 1."""
    if mask is None:
        return fmaps.new_full(fmaps.shape[:-2], 1 / fmaps.shape[-3])
    return mask.to(fmaps.dtype) / mask.sum(-1, keepdim=True)


def _sum_over_maps(evecs: Tensor, group: Tensor, mask: Tensor | None) -> Tensor:
    """``sum_g Phi[g]``: one gather of rows for each element but the identity, on one flat table (quicker on CPUs)."""
    *front, n, k = evecs.shape
    table = evecs.reshape(-1, k)
    offsets = torch.arange(table.shape[0] // n, device=group.device).reshape(*front, 1) * n
    total = table
    for g in range(1, group.shape[-2]):
        moved = table.index_select(0, (group[..., g, :] + offsets).reshape(-1))
        if mask is not None:
            moved = moved * mask[..., g, None].expand(*front, n).reshape(-1, 1)
        total = moved.add_(total)  # `moved` is ours: no further (V, K) tensor is made
    return total.reshape(evecs.shape)


def _inner_products(f: Tensor, g: Tensor, mass: Tensor) -> Tensor:
    """``F^T diag(mass) G`` of functions as columns."""
    product: Tensor = _InnerProducts.apply(f, g, mass)
    return product


class _InnerProducts(torch.autograd.Function):
    """Autograd's own would keep ``diag(mass) F`` and make gradients transposed, which costs copies of (V, K)."""

    generate_vmap_rule = True

    @staticmethod
    def forward(f: Tensor, g: Tensor, mass: Tensor) -> Tensor:
        return (f * mass[..., None]).mT @ g

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        f, g, mass = ctx.saved_tensors
        (grad,) = grads
        grad_f = grad_g = grad_mass = None
        if ctx.needs_input_grad[0] or ctx.needs_input_grad[2]:
            pulled = g @ grad.mT
            grad_mass = (f * pulled).sum(-1) if ctx.needs_input_grad[2] else None
            grad_f = pulled * mass[..., None]
        if ctx.needs_input_grad[1]:
            grad_g = (f @ grad) * mass[..., None]
        return grad_f, grad_g, grad_mass
