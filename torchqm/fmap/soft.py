"""Soft point maps from features: a softmax over the vertices of the target, or over the k best of them only."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.checks import Sizes, enabled, require_finite, require_ids, require_mask
from torchqm.fmap.feature_search import KINDS, best_neighbours, with_bias
from torchqm.fmap.pair_products import PairProducts, at_neighbours
from torchqm.spectral.soft_map import SoftMap

__all__ = ["feature_neighbours", "soft_assignment", "soft_map"]


def soft_assignment(log_alpha: Float[Tensor, "..."], tau: float = 0.2, dim: int = -1, hard: bool = False) -> Tensor:
    """``softmax(log_alpha / tau)`` along one dimension; ``hard``: its largest entry as 0 / 1, with the soft gradient.

    Args:
        log_alpha: similarities, of any shape.
        tau: temperature, positive.
        dim: dimension that sums to 1.
        hard: values of the one-hot matrix of the largest entries, gradients of the softmax (straight-through).

    Returns:
        A tensor of the same shape.

    Raises:
        ValueError: ``tau`` is not positive, or a similarity is not finite.

    Example:
        >>> soft_assignment(torch.tensor([0.0, 1.0]), hard=True).tolist()
        [0.0, 1.0]

    References:
        Cao et al., Unsupervised learning of robust spectral shape matching (SIGGRAPH 2023), section 4.2.
    """
    _require_tau(tau)
    require_finite("log_alpha", log_alpha)
    if not -log_alpha.ndim <= dim < log_alpha.ndim:
        raise ValueError(f"dim: {dim} given, but log_alpha has {log_alpha.ndim} dimensions")
    if not log_alpha.shape[dim]:
        raise ValueError(f"log_alpha: shape {tuple(log_alpha.shape)} given, expected entries along dimension {dim}")
    # Shifted before it is divided: no temperature, however small, makes an infinity out of a finite similarity.
    alpha = torch.softmax((log_alpha - log_alpha.detach().amax(dim, keepdim=True)) / tau, dim)
    if not hard:
        return alpha
    one_hot = torch.zeros_like(alpha).scatter(dim, alpha.argmax(dim, keepdim=True), 1.0)
    return one_hot + (alpha - alpha.detach())


def soft_map(
    feat_x: Float[Tensor, "*B X C"],
    feat_y: Float[Tensor, "*B Y C"],
    tau: float | Tensor,
    k: int | None = None,
    mask_x: Bool[Tensor, "*B X"] | None = None,
    mask_y: Bool[Tensor, "*B Y"] | None = None,
    kind: str = "dot",
    normalize: bool = False,
    include: Int[Tensor, "*B X M"] | None = None,
    chunk: int | None = None,
) -> SoftMap | Float[Tensor, "*B X Y"]:
    """``Pi_xy = softmax_y(<f_x, f_y> / tau)`` or ``softmax_y(-|f_x - f_y|^2 / tau)``: weights over y for each x.

    With ``k`` the softmax runs over the k vertices of y that are best for x (others: weight 0, no gradient). These are
    chosen without gradients in blocks of rows, and their similarities computed again in blocks, forward and backward:
    neither an ``(X, Y)`` nor an ``(X, k, C)`` tensor is made.

    Args:
        feat_x: ``(..., X, C)`` features of x.
        feat_y: ``(..., Y, C)`` features of y.
        tau: temperature, positive (for distances in the unit of ``|f|^2``); a number, or a tensor of one element, which
            may need a gradient.
        k: neighbours kept for each x; all of y, as a dense matrix, if not given.
        mask_x: ``(..., X)`` real vertices of x; rows of the others are 0.
        mask_y: ``(..., Y)`` real vertices of y; the others get no weight.
        kind: ``dot`` or ``distance``.
        normalize: divide each feature vector by its length first (a vector of length 0 stays 0).
        include: ``(..., X, M)`` vertices of y that are kept among the k whatever their similarity, e.g. the truth's
            orbit (:func:`torchqm.fmap.orbit_truth.orbit_members`), so that it gets a gradient; -1: none.
        chunk: rows of x taken at once, with ``k`` only; by default as many as fit blocks of 16 MiB (float32).

    Returns:
        A dense ``(..., X, Y)`` matrix, or a :class:`torchqm.spectral.SoftMap` of k neighbours, best first. Where y has
        less than k real vertices the remaining places name the best one again, with weight 0.

    Raises:
        ValueError: shapes do not fit, features are not finite or too large for this ``tau``, ``tau`` is not positive,
            ``k`` is not in ``1..Y``, or ``kind``, ``include`` or ``chunk`` make no sense.

    Note:
        Fullgraph compilation and ``torch.func`` (``vmap``, ``grad``) work for both forms; forward-mode derivatives
        only for the dense one.

    Example:
        >>> x, y = torch.tensor([[1.0, 0.0]]), torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.9, 0.1]])
        >>> soft_map(x, y, 0.1, k=2).indices.tolist(), soft_map(x, y, 1e-4).tolist()
        ([[0, 2]], [[1.0, 0.0, 0.0]])
    """
    _check(feat_x, feat_y, mask_x, mask_y, kind, k, include, chunk)
    _require_tau(tau)
    feat_x, feat_y, bias = with_bias(feat_x, feat_y, mask_y, kind, normalize)
    _require_range(feat_x, feat_y, tau, bias is not None)
    factor = (1.0 if bias is None else 2.0) / (tau.to(feat_x) if isinstance(tau, Tensor) else tau)
    real = mask_x
    if mask_y is not None:
        real = mask_y.any(-1, keepdim=True) if real is None else real & mask_y.any(-1, keepdim=True)
    if k is None:
        logits = (feat_x * factor) @ feat_y.transpose(-1, -2)
        if bias is not None:
            logits = logits + (bias * factor)[..., None, :]
        if mask_y is not None:
            logits = logits.masked_fill(~mask_y[..., None, :], torch.finfo(logits.dtype).min)
        weights = torch.softmax(logits, -1)
        return weights if real is None else weights * real[..., None]
    indices = best_neighbours(feat_x.detach(), feat_y.detach(), bias, mask_y, k, include, chunk)
    logits = PairProducts.apply(feat_x, feat_y, indices, chunk)
    if bias is not None:
        logits = logits + at_neighbours(bias, indices)
    logits = logits * factor
    if mask_y is not None:
        kept = at_neighbours(mask_y, indices)
        logits = logits.masked_fill(~kept, torch.finfo(logits.dtype).min)
        indices = torch.where(kept, indices, indices[..., :1])
    weights = torch.softmax(logits, -1)
    return SoftMap(indices, weights if real is None else weights * real[..., None], feat_y.shape[-2])


def feature_neighbours(
    feat_x: Float[Tensor, "*B X C"],
    feat_y: Float[Tensor, "*B Y C"],
    k: int = 1,
    mask_y: Bool[Tensor, "*B Y"] | None = None,
    kind: str = "dot",
    normalize: bool = False,
    chunk: int | None = None,
) -> Int[Tensor, "*B X k"]:
    """The k vertices of y most similar to each vertex of x, best first; arguments as in :func:`soft_map`.

    Example:
        >>> feature_neighbours(torch.tensor([[0.9]]), torch.tensor([[0.0], [1.0]]), kind="distance").tolist()
        [[1]]
    """
    _check(feat_x, feat_y, None, mask_y, kind, k, None, chunk)
    with torch.no_grad():
        feat_x, feat_y, bias = with_bias(feat_x.detach(), feat_y.detach(), mask_y, kind, normalize)
        return best_neighbours(feat_x, feat_y, bias, mask_y, k, None, chunk)


def _require_tau(tau: float | Tensor) -> None:
    if isinstance(tau, Tensor) and (tau.numel() != 1 or not enabled()):
        if tau.numel() != 1:
            raise ValueError(f"tau: shape {tuple(tau.shape)} given, expected a number or a tensor of one element")
        return
    value = float(tau.detach()) if isinstance(tau, Tensor) else tau
    if not 0 < value < float("inf"):
        raise ValueError(f"tau: {value:.3g} given, expected a positive number")


def _require_range(feat_x: Tensor, feat_y: Tensor, tau: float | Tensor, squared: bool) -> None:
    if not enabled() or not feat_x.numel() or not feat_y.numel():
        return
    x, y = (float(feat.detach().abs().amax()) for feat in (feat_x, feat_y))
    value = float(tau.detach()) if isinstance(tau, Tensor) else tau
    largest = feat_x.shape[-1] * y * (2 * x + y if squared else x) / value
    if not largest < torch.finfo(feat_x.dtype).max:
        raise ValueError(
            f"tau: {value:.3g} is too small for features as large as {max(x, y):.3g}: their similarities divided "
            f"by it would leave the range of {feat_x.dtype}"
        )


def _check(
    feat_x: Tensor,
    feat_y: Tensor,
    mask_x: Tensor | None,
    mask_y: Tensor | None,
    kind: str,
    k: int | None,
    include: Tensor | None,
    chunk: int | None,
) -> None:
    sizes = Sizes()
    sizes.bind("feat_x", feat_x, "... X C")
    sizes.bind("feat_y", feat_y, "... Y C")
    require_finite("feat_x", feat_x)
    require_finite("feat_y", feat_y)
    for name, mask, dims in (("mask_x", mask_x, "... X"), ("mask_y", mask_y, "... Y")):
        if mask is not None:
            sizes.bind(name, mask, dims)
            require_mask(name, mask)
    if kind not in KINDS:
        raise ValueError(f"kind: {kind!r} given, allowed are {', '.join(KINDS)}")
    if k is None and (chunk is not None or include is not None):
        raise ValueError(f"{'chunk' if chunk is not None else 'include'}: only of use together with k")
    if k is not None and not 1 <= k <= sizes["Y"]:
        raise ValueError(f"k: {k} given, but feat_y has {sizes['Y']} vertices, so 1..{sizes['Y']} is allowed")
    if chunk is not None and chunk < 1:
        raise ValueError(f"chunk: {chunk} given, expected 1 or more rows")
    if include is not None and k is not None:
        sizes.bind("include", include, "... X M")
        if not sizes["M"] <= k:
            raise ValueError(f"include: {sizes['M']} vertices a row given, but only k = {k} are kept")
        require_ids("include", include, sizes["Y"], none=True)
