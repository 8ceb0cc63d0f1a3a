"""Even and odd bases as a layer."""

from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from torchqm.checks import Sizes, require_finite
from torchqm.options import require_number, require_whole
from torchqm.symmetry.halves import symmetrized_projector
from torchqm.symmetry.soft import projection_matrices
from torchqm.symmetry.split import SplitBases, symmetrized_bases

__all__ = ["SymmetrizedBasis"]


class SymmetrizedBasis(nn.Module):
    """From eigenpairs and a symmetry to the bases of even and odd functions, with gauge-invariant gradients.

    The symmetry is one of ``group`` (vertex maps ``(B, G, V)``), ``fmaps`` (functional matrices ``(B, G, K, K)``, or
    ``(B, K, K)`` of one reflection) and ``soft_map`` (a :class:`torchqm.spectral.SoftMap` of each shape to itself, or a
    dense ``(B, V, V)`` tensor). Gradients go to the eigenpairs, the areas and, except for vertex maps, to the symmetry.

    Args:
        k_even: width of the even half, padded or cut to the lowest; None: the largest of the batch. ``torch.compile``
            in one graph, ``torch.export`` and ``torch.func.vmap`` need numbers.
        k_odd: that of the odd half.
        rtol: gaps of eigenvalues that count as zero in the backward pass, as a share of the largest eigenvalue; None:
            1e-10 in float64 and 1e-5 in float32.

    Raises:
        ValueError: a negative width or ``rtol``.

    Example:
        >>> import torch
        >>> evecs = torch.tensor([[[1.0, 1.0], [1.0, -1.0]]]) / 2**0.5
        >>> layer = SymmetrizedBasis()
        >>> split = layer(torch.tensor([[0.0, 3.0]]), evecs, torch.ones(1, 2), group=torch.tensor([[[0, 1], [1, 0]]]))
        >>> split.evals_even.tolist(), split.evals_odd.tolist()
        ([[0.0]], [[3.0]])
    """

    def __init__(self, k_even: int | None = None, k_odd: int | None = None, rtol: float | None = None) -> None:
        super().__init__()
        require_whole("k_even", k_even, 0, optional=True)
        require_whole("k_odd", k_odd, 0, optional=True)
        if rtol is not None:
            require_number("rtol", rtol, least=0)
        self.k_even, self.k_odd, self.rtol = k_even, k_odd, rtol

    def forward(
        self, evals: Float[Tensor, "*B K"], evecs: Float[Tensor, "*B V K"], mass: Float[Tensor, "*B V"], **given: Any
    ) -> SplitBases:
        """Both bases.

        Args:
            evals: ``(B, K)`` eigenvalues.
            evecs: ``(B, V, K)`` eigenfunctions, orthonormal in ``mass``.
            mass: ``(B, V)`` vertex areas.
            **given: the symmetry, and ``group_mask (B, G)``, ``verts_mask (B, V)``, ``evals_mask (B, K)`` of a padded
                batch: the keywords of :func:`torchqm.symmetry.symmetrized_bases`.
        """
        return symmetrized_bases(evals, evecs, mass, k_even=self.k_even, k_odd=self.k_odd, rtol=self.rtol, **given)

    def projector(
        self, evecs: Float[Tensor, "*B V K"], mass: Float[Tensor, "*B V"], **given: Any
    ) -> Float[Tensor, "*B K K"]:
        """The basis-free variant: the orthogonal projector onto even functions, written in the full basis.

        Smooth wherever the symmetry is nearly exact, at equal eigenvalues too, and of fixed size.

        Args:
            evecs: ``(B, V, K)``.
            mass: ``(B, V)``.
            **given: as in :meth:`forward`.
        """
        projection = projection_matrices(evecs, mass, **given)
        return symmetrized_projector(projection, evals_mask=given.get("evals_mask"), rtol=self.rtol)

    def parts(
        self,
        coeffs: Float[Tensor, "*B K C"],
        evecs: Float[Tensor, "*B V K"],
        mass: Float[Tensor, "*B V"],
        **given: Any,
    ) -> tuple[Float[Tensor, "*B K C"], Float[Tensor, "*B K C"]]:
        """Even and odd part of functions given by their coefficients in the full basis, by :meth:`projector`.

        Args:
            coeffs: ``(B, K, C)`` coefficients of C functions.
            evecs: ``(B, V, K)``.
            mass: ``(B, V)``.
            **given: as in :meth:`forward`.
        """
        sizes = Sizes()
        sizes.bind("evecs", evecs, "... V K")
        sizes.bind("coeffs", coeffs, "... K C")
        require_finite("coeffs", coeffs)
        even = self.projector(evecs, mass, **given) @ coeffs
        return even, coeffs - even

    def extra_repr(self) -> str:
        """The options, for ``print``."""
        return f"k_even={self.k_even}, k_odd={self.k_odd}, rtol={self.rtol}"
