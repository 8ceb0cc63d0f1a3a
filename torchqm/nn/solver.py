"""The regularised functional map as a layer."""

from math import log
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchqm.checks import Sizes, require_finite, require_mask
from torchqm.fmap.commutativity import COMMUTATIVITY
from torchqm.fmap.regularized import descriptor_coefficients, regularized_blocks
from torchqm.options import require_choice, require_flag, require_number, require_whole

__all__ = ["FunctionalMapSolver"]

FMap = Float[Tensor, "*B _Ky _Kx"]
_Basis = tuple[Tensor, Tensor, Tensor | None]


class FunctionalMapSolver(nn.Module):
    """From descriptors and bases to functional maps; called as ULRSSM's ``RegularizedFMNet``, with the same result.

    It minimises ``s sum_c w_c || C a_c - b_c ||^2 + lmbda sum_ij D_ij C_ij^2``, where a_c and b_c are the coefficients
    of the features in the two bases (:func:`torchqm.fmap.regularized.regularized_fmap`). Further pairs of descriptors
    (odd ones, which tell left from right) and a second basis (odd functions, for a block-diagonal map) are optional.

    Args:
        lmbda: weight of commutativity.
        resolvant_gamma: exponent of the resolvent mask (its name in ULRSSM).
        bidirectional: solve for the map from y to x, too.
        commutativity: ``resolvent``, ``normalized`` or ``squared``, see
            :func:`torchqm.fmap.commutativity.commutativity_mask`.
        learn_lmbda: make ``lmbda`` a parameter; its logarithm is learned, so that it stays positive.
        extra_weight: weight of the further descriptors against the features.
        ridge: multiple of the mean descriptor energy added to every diagonal; to have a say in float32, 1e-4 or more.
        row_chunk: rows solved at once, to bound memory: the backward pass then factors again. None: all, and the factor
            is kept for the backward pass.

    Example:
        >>> import torch
        >>> evals, eye = torch.tensor([[0.0, 1.0]]), torch.eye(2)[None]
        >>> fmap_xy, fmap_yx = FunctionalMapSolver()(eye, -eye, evals, evals, eye, eye)
        >>> fmap_xy.tolist(), fmap_yx
        ([[[-1.0, 0.0], [0.0, -1.0]]], None)

    References:
        Paper, section 4.3; Cao, Roetzer, Bernard, Unsupervised Learning of Robust Spectral Shape Matching, 2023.
    """

    def __init__(
        self,
        lmbda: float = 100.0,
        resolvant_gamma: float = 0.5,
        bidirectional: bool = False,
        *,
        commutativity: str = "resolvent",
        learn_lmbda: bool = False,
        extra_weight: float = 1.0,
        ridge: float = 0.0,
        row_chunk: int | None = None,
    ) -> None:
        super().__init__()
        require_flag("learn_lmbda", learn_lmbda)
        if learn_lmbda:  # its logarithm is
            require_number("lmbda", lmbda, above=0)
        for name, number in (("lmbda", lmbda), ("extra_weight", extra_weight), ("ridge", ridge)):
            require_number(name, number, least=0)
        require_number("resolvant_gamma", resolvant_gamma, above=0)
        require_flag("bidirectional", bidirectional)
        require_choice("commutativity", commutativity, COMMUTATIVITY)
        require_whole("row_chunk", row_chunk, optional=True)
        self.resolvant_gamma, self.bidirectional, self.commutativity = resolvant_gamma, bidirectional, commutativity
        self.extra_weight, self.ridge, self.row_chunk = extra_weight, ridge, row_chunk
        self._lmbda = lmbda
        self.log_lmbda = nn.Parameter(torch.tensor(log(lmbda))) if learn_lmbda else None

    @property
    def lmbda(self) -> float | Tensor:
        """Weight of commutativity: the number given, or the learned one."""
        return self._lmbda if self.log_lmbda is None else self.log_lmbda.exp()

    def forward(
        self,
        feat_x: Float[Tensor, "*B Vx C"],
        feat_y: Float[Tensor, "*B Vy C"],
        evals_x: Float[Tensor, "*B Kx"],
        evals_y: Float[Tensor, "*B Ky"],
        evecs_trans_x: Float[Tensor, "*B Kx Vx"],
        evecs_trans_y: Float[Tensor, "*B Ky Vy"],
        *,
        evals_mask_x: Bool[Tensor, "*B Kx"] | None = None,
        evals_mask_y: Bool[Tensor, "*B Ky"] | None = None,
        extra_x: Float[Tensor, "*B Vx E"] | None = None,
        extra_y: Float[Tensor, "*B Vy E"] | None = None,
        weights: Float[Tensor, "..."] | None = None,
        sample_weights: Float[Tensor, "*B"] | None = None,
        evals_odd_x: Float[Tensor, "*B Ox"] | None = None,
        evals_odd_y: Float[Tensor, "*B Oy"] | None = None,
        evecs_trans_odd_x: Float[Tensor, "*B Ox Vx"] | None = None,
        evecs_trans_odd_y: Float[Tensor, "*B Oy Vy"] | None = None,
        evals_odd_mask_x: Bool[Tensor, "*B Ox"] | None = None,
        evals_odd_mask_y: Bool[Tensor, "*B Oy"] | None = None,
    ) -> tuple[FMap | tuple[FMap, ...], FMap | tuple[FMap, ...] | None]:
        """The map from x to y and, if ``bidirectional``, from y to x (else None).

        Args:
            feat_x: ``(B, Vx, C)`` descriptors at the vertices of x.
            feat_y: ``(B, Vy, C)`` the same at those of y.
            evals_x: ``(B, Kx)`` eigenvalues of x; Kx and Ky may differ.
            evals_y: ``(B, Ky)`` those of y.
            evecs_trans_x: ``(B, Kx, Vx)`` transposed basis of x times its vertex areas.
            evecs_trans_y: ``(B, Ky, Vy)`` that of y.
            evals_mask_x: ``(B, Kx)`` true: real, false: padding.
            evals_mask_y: ``(B, Ky)``.
            extra_x: ``(B, Vx, E)`` further descriptors, such as odd ones, with weight ``extra_weight``.
            extra_y: ``(B, Vy, E)``.
            weights: ``(C,)`` or ``(B, C)`` of the features.
            sample_weights: ``(B,)`` of the descriptors of each pair, against ``lmbda``.
            evals_odd_x: ``(B, Ox)`` eigenvalues of a second basis. With it the basis above is that of the even
                functions; each descriptor counts in both blocks, with its even and its odd part.
            evals_odd_y: ``(B, Oy)``.
            evecs_trans_odd_x: ``(B, Ox, Vx)``.
            evecs_trans_odd_y: ``(B, Oy, Vy)``.
            evals_odd_mask_x: ``(B, Ox)``; may be all false for a shape without symmetry.
            evals_odd_mask_y: ``(B, Oy)``.

        Returns:
            ``(fmap_xy, fmap_yx)``: ``(B, Ky, Kx)``, takes functions on x to functions on y, and ``(B, Kx, Ky)`` or
            None. With odd bases each of the two is a pair: even to even, odd to odd.

        Raises:
            ValueError: see :func:`torchqm.fmap.regularized.regularized_fmap`; also where one of several arguments that
                need each other is missing. In float32 rows count as undetermined, too, of which rounding would leave
                one digit or less, and ULRSSM's inverses return noise: of fewer descriptors than functions that are
                large against ``lmbda``, some ten times as large as functions on a shape of area 1, e.g. because
                shapes were not scaled. Scale them, or give a ``ridge`` of 1e-3 (float32), or float64.
        """
        if (extra_x is None) != (extra_y is None):
            raise ValueError("extra_x, extra_y: give both or none")
        sizes = Sizes()
        every = {
            "feat_x": (feat_x, "... Vx C"),
            "feat_y": (feat_y, "... Vy C"),
            "evecs_trans_x": (evecs_trans_x, "... Kx Vx"),
            "evecs_trans_y": (evecs_trans_y, "... Ky Vy"),
            "evals_x": (evals_x, "... Kx"),
            "evals_y": (evals_y, "... Ky"),
            "evals_mask_x": (evals_mask_x, "... Kx"),
            "evals_mask_y": (evals_mask_y, "... Ky"),
            "extra_x": (extra_x, "... Vx E"),
            "extra_y": (extra_y, "... Vy E"),
            "evals_odd_x": (evals_odd_x, "... Ox"),
            "evals_odd_y": (evals_odd_y, "... Oy"),
            "evecs_trans_odd_x": (evecs_trans_odd_x, "... Ox Vx"),
            "evecs_trans_odd_y": (evecs_trans_odd_y, "... Oy Vy"),
            "evals_odd_mask_x": (evals_odd_mask_x, "... Ox"),
            "evals_odd_mask_y": (evals_odd_mask_y, "... Oy"),
        }
        for name, (value, dims) in every.items():
            if value is not None:
                sizes.bind(name, value, dims)
                if "mask" in name:  # a shape without symmetry has no odd functions
                    require_mask(name, value, empty="odd" in name)
                elif name.startswith("evals"):
                    require_finite(name, value)
        bases_x: list[_Basis] = [(evals_x, evecs_trans_x, evals_mask_x)]
        bases_y: list[_Basis] = [(evals_y, evecs_trans_y, evals_mask_y)]
        odd = (evals_odd_x, evals_odd_y, evecs_trans_odd_x, evecs_trans_odd_y)
        if evals_odd_x is not None and evals_odd_y is not None and all(part is not None for part in odd):
            bases_x.append((evals_odd_x, cast(Tensor, evecs_trans_odd_x), evals_odd_mask_x))
            bases_y.append((evals_odd_y, cast(Tensor, evecs_trans_odd_y), evals_odd_mask_y))
        elif any(part is not None for part in (*odd, evals_odd_mask_x, evals_odd_mask_y)):
            raise ValueError("evals_odd_x, evals_odd_y, evecs_trans_odd_x, evecs_trans_odd_y: give all four or none")
        halves = ("", "odd_")
        coeffs_x, coeffs_y = (
            [
                _coefficients(feat, extra, trans, f"evecs_trans_{half}{side}", side)
                for (_, trans, _), half in zip(bases, halves, strict=False)
            ]
            for feat, extra, bases, side in ((feat_x, extra_x, bases_x, "x"), (feat_y, extra_y, bases_y, "y"))
        )
        x, y = (coeffs_x, bases_x), (coeffs_y, bases_y)
        weights = self._with_extra(weights, feat_x, extra_x)
        found = [
            regularized_blocks(
                from_coeffs,
                to_coeffs,
                [evals for evals, _, _ in source],
                [evals for evals, _, _ in target],
                self.lmbda,
                commutativity=self.commutativity,
                gamma=self.resolvant_gamma,
                weights=weights,
                sample_weights=sample_weights,
                ridge=self.ridge,
                evals_mask_x=[mask for _, _, mask in source],
                evals_mask_y=[mask for _, _, mask in target],
                row_chunk=self.row_chunk,
            )
            for (from_coeffs, source), (to_coeffs, target) in ([(x, y), (y, x)] if self.bidirectional else [(x, y)])
        ]
        maps = [blocks if len(bases_x) > 1 else blocks[0] for blocks in found]
        return maps[0], maps[1] if self.bidirectional else None

    def _with_extra(self, weights: Tensor | None, feat: Tensor, extra: Tensor | None) -> Tensor | None:
        if extra is None:
            return weights
        own = feat.new_ones(feat.shape[-1]) if weights is None else weights
        return torch.cat([own, own.new_full((*own.shape[:-1], extra.shape[-1]), self.extra_weight)], -1)

    def extra_repr(self) -> str:
        """The options, for ``print``."""
        shown = "learned" if self.log_lmbda is not None else self._lmbda
        return f"lmbda={shown}, commutativity={self.commutativity!r}, bidirectional={self.bidirectional}"


def _coefficients(feat: Tensor, extra: Tensor | None, evecs_trans: Tensor, basis: str, side: str) -> Tensor:
    coeffs = descriptor_coefficients(feat, evecs_trans, (f"feat_{side}", basis))
    if extra is None:
        return coeffs
    return torch.cat([coeffs, descriptor_coefficients(extra, evecs_trans, (f"extra_{side}", basis))], -1)
