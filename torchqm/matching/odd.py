"""The odd half of a map, and with it the difference between direct and mirrored, once the even half is known."""

from dataclasses import dataclass
from functools import partial

from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.refine import nearest_isometry
from torchqm.fmap.solve import solve_fmap
from torchqm.fmap.threads import in_parallel
from torchqm.geometry.mesh import Mesh
from torchqm.matching.initial import unit_columns_pair
from torchqm.matching.parameters import MatchError
from torchqm.spectral.basis import SpectralBasis
from torchqm.symmetry.basis import EvenOddBasis
from torchqm.symmetry.orientation import function_pairs, orientation_coefficients

__all__ = ["OddMap", "join_blocks", "solve_odd"]


@dataclass(frozen=True, eq=False)
class OddMap:
    """The odd block of the orientation-preserving map, and how clearly its sign is told from the other.

    Args:
        fmap: ``(Ko_y, Ko_x)`` orthonormal; ``-fmap`` is the odd block of the mirrored map.
        residual_direct: relative residual ``|| C F - G || / || G ||`` of the orientation descriptors under ``fmap``.
        residual_mirrored: the same under ``-fmap``.
    """

    fmap: Float[Tensor, "Koy Kox"]
    residual_direct: float
    residual_mirrored: float

    @property
    def separated(self) -> bool:
        """Whether the residuals tell the two signs apart: the mirrored one is larger by half at least."""
        return self.residual_mirrored > 1.5 * self.residual_direct


def solve_odd(
    mesh_x: Mesh,
    mesh_y: Mesh,
    even_x: SpectralBasis,
    even_y: SpectralBasis,
    fmap_even: Float[Tensor, "Key Kex"],
    odd_x: SpectralBasis,
    odd_y: SpectralBasis,
    n_functions: int = 10,
    commutativity: float = 100.0,
) -> OddMap:
    """Solve for the map between odd functions from pairs of low even functions and their images.

    ``omega(f_a, f_b)`` of the first even functions of x corresponds to ``omega(C+ f_a, C+ f_b)`` on y, if the map keeps
    orientation; with the wrong orientation it corresponds to its negative. Least squares with commutativity, as for
    the even block, then the nearest isometry.

    Args:
        mesh_x: source, consistently oriented, normals outward.
        mesh_y: target, likewise.
        even_x: basis of L2+ of the source with at least the Kex functions of ``fmap_even``.
        even_y: basis of L2+ of the target.
        fmap_even: the even block.
        odd_x: basis of L2- of the source.
        odd_y: basis of L2- of the target.
        n_functions: how many even functions to pair.
        commutativity: weight per (descriptor / basis function).

    Raises:
        MatchError: fewer than three even functions, so there are no pairs, or no odd functions on one of the shapes.
    """
    n = min(n_functions, fmap_even.shape[1])
    if n < 3:
        raise MatchError(
            f"n_functions={n}: at least 3 even functions are needed to make a pair of non-constant ones; "
            "take a larger k"
        )
    if not odd_x.k or not odd_y.k:
        raise MatchError(
            f"{mesh_x.label} has {odd_x.k} odd functions and {mesh_y.label} has {odd_y.k} among the first "
            f"{even_x.k + odd_x.k} and {even_y.k + odd_y.k}: none can be matched; take a larger k"
        )
    pairs = function_pairs(n)
    images = even_y.evecs[:, : fmap_even.shape[0]] @ fmap_even[:, :n]
    both = ((mesh_x, even_x.evecs[:, :n], pairs, odd_x.evecs), (mesh_y, images, pairs, odd_y.evecs))
    f, g = unit_columns_pair(*in_parallel([partial(orientation_coefficients, *one) for one in both]))
    fmap = nearest_isometry(
        solve_fmap(f, g, odd_x.evals, odd_y.evals, commutativity * f.shape[1] / odd_x.k, ridge=1e-9)
    )
    scale = g.norm().clamp_min(1e-300)
    return OddMap(fmap, float((fmap @ f - g).norm() / scale), float((fmap @ f + g).norm() / scale))


def join_blocks(
    x: EvenOddBasis,
    y: EvenOddBasis,
    fmap_even: Float[Tensor, "Key Kex"],
    fmap_odd: Float[Tensor, "Koy Kox"],
) -> Float[Tensor, "Ky Kx"]:
    """``C = U+_y C+ U+_x^T + U-_y C- U-_x^T``: even and odd block as one map between the full bases."""
    return y.even_coeffs @ fmap_even @ x.even_coeffs.T + y.odd_coeffs @ fmap_odd @ x.odd_coeffs.T
