"""Soft point maps as layers."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchqm.fmap.feature_search import KINDS
from torchqm.fmap.soft import soft_assignment, soft_map
from torchqm.options import require_choice, require_flag, require_number, require_whole
from torchqm.spectral.soft_map import SoftMap

__all__ = ["Similarity", "SoftPointMap"]


class Similarity(nn.Module):
    """``softmax(log_alpha / tau)``: call and result of ULRSSM's class of this name.

    Args:
        normalise_dim: dimension that sums to 1.
        tau: temperature, positive.
        hard: one-hot values with the gradient of the softmax (straight-through).

    Example:
        >>> Similarity(tau=0.5)(torch.zeros(1, 2, 4))[0, 0].tolist()
        [0.25, 0.25, 0.25, 0.25]

    References:
        :func:`torchqm.fmap.soft.soft_assignment`.
    """

    def __init__(self, normalise_dim: int = -1, tau: float = 0.2, hard: bool = False) -> None:
        super().__init__()
        require_whole("normalise_dim", normalise_dim, least=None)
        require_number("tau", tau, above=0)
        require_flag("hard", hard)
        self.dim, self.tau, self.hard = normalise_dim, tau, hard

    def forward(self, log_alpha: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """A tensor of the same shape."""
        return soft_assignment(log_alpha, self.tau, self.dim, self.hard)

    def extra_repr(self) -> str:
        """The options, for ``print``."""
        return f"normalise_dim={self.dim}, tau={self.tau}, hard={self.hard}"


class SoftPointMap(nn.Module):
    """Weights over the vertices of y for each vertex of x, from features: :func:`torchqm.fmap.soft.soft_map`.

    Args:
        tau: temperature, positive.
        learn_tau: make it a parameter (its logarithm, ``log_tau``).
        k: neighbours kept for each x: a sparse map in bounded memory; all, as a dense matrix, if not given.
        kind: ``dot``, ``<f_x, f_y> / tau``, or ``distance``, ``-|f_x - f_y|^2 / tau``.
        normalize: divide each feature vector by its length first.
        chunk: rows taken at once, with ``k`` only; by default as many as fit blocks of 16 MiB.

    Example:
        >>> features = torch.eye(3)[None]
        >>> SoftPointMap(tau=0.01)(features, features)[0].argmax(-1).tolist()
        [0, 1, 2]
    """

    def __init__(
        self,
        tau: float = 0.2,
        learn_tau: bool = False,
        k: int | None = None,
        kind: str = "dot",
        normalize: bool = False,
        chunk: int | None = None,
    ) -> None:
        super().__init__()
        require_number("tau", tau, above=0)
        require_flag("learn_tau", learn_tau)
        require_whole("k", k, optional=True)
        require_choice("kind", kind, KINDS)
        require_flag("normalize", normalize)
        require_whole("chunk", chunk, optional=True)
        if k is None and chunk is not None:
            raise ValueError(f"chunk: {chunk} given, but only of use together with k")
        self._tau = tau
        self.log_tau = nn.Parameter(torch.tensor(math.log(tau))) if learn_tau else None
        self.k, self.kind, self.normalize, self.chunk = k, kind, normalize, chunk

    @property
    def tau(self) -> float | Tensor:
        """The temperature; a tensor with a gradient where it is learned."""
        return self._tau if self.log_tau is None else self.log_tau.exp()

    def forward(
        self,
        feat_x: Float[Tensor, "*B X C"],
        feat_y: Float[Tensor, "*B Y C"],
        verts_mask_x: Bool[Tensor, "*B X"] | None = None,
        verts_mask_y: Bool[Tensor, "*B Y"] | None = None,
        include: Int[Tensor, "*B X M"] | None = None,
    ) -> SoftMap | Float[Tensor, "*B X Y"]:
        """The map from x to y.

        Args:
            feat_x: ``(B, X, C)`` features of x.
            feat_y: ``(B, Y, C)`` features of y.
            verts_mask_x: ``(B, X)`` real vertices; rows of padding are 0.
            verts_mask_y: ``(B, Y)`` real vertices; padding gets no weight.
            include: ``(B, X, M)`` vertices of y that are among the k in any case; -1: none.

        Returns:
            Dense ``(B, X, Y)``, or a :class:`torchqm.spectral.SoftMap` if the layer has a ``k``.
        """
        return soft_map(
            *(feat_x, feat_y, self.tau, self.k, verts_mask_x, verts_mask_y),
            kind=self.kind,
            normalize=self.normalize,
            include=include,
            chunk=self.chunk,
        )

    def extra_repr(self) -> str:
        """The options, for ``print``."""
        learned = "" if self.log_tau is None else ", learn_tau=True"
        tau = self.tau.item() if isinstance(self.tau, Tensor) else self.tau
        return f"tau={tau:.3g}{learned}, k={self.k}, kind={self.kind}, normalize={self.normalize}"
