"""Functional maps that know the orientation of the surface, as a start for ZoomOut: the self-symmetry of a shape.

Descriptors say that a point looks like its mirror image; their orientation operators
``Omega_f(h) = n . (grad f x grad h)`` say which way round. What turns the surface over satisfies
``C Omega_f = -Omega_g C``.

References:
    Ren, Poulenard, Wonka, Ovsjanikov. Continuous and orientation-preserving correspondences via functional maps.
    SIGGRAPH Asia 2018, the energy of four terms for orientation-preserving (and, with the other sign, -reversing) maps.
    It is a quadratic, and minimised here by one linear solve.
    Melzi et al. SIGGRAPH Asia 2019 (ZoomOut), self-symmetry: ``OrientRev`` as the start.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.convert import fmap_to_p2p
from torchqm.fmap.energy import commutativity_weights
from torchqm.matching.baselines.base import NOTHING, BaselineResult, Given, make_result, shared_size
from torchqm.matching.baselines.zoomout import zoomout, zoomout_sizes
from torchqm.matching.initial import basis_size, unit_columns_pair
from torchqm.matching.parameters import MatchError
from torchqm.matching.quality import orientation_agreement, orientation_label
from torchqm.matching.shape import PreparedShape
from torchqm.matching.steps import Steps
from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.descriptors import wave_energies, wave_kernel_signature
from torchqm.symmetry.orientation import orientation_coefficients

__all__ = ["OrientRev", "OrientationWeights", "orientation_fmap", "orientation_operators"]

Operators = Float[Tensor, "N _K _K"]


@dataclass(frozen=True)
class OrientationWeights:
    """Weights of the four terms; each term is first divided by the mean of its diagonal, so that they have no unit.

    Args:
        descriptors: ``sum_f || C f - g ||^2``.
        products: ``sum_f || C M_f - M_g C ||^2``, ``M_f`` multiplication by f.
        laplacian: ``|| C Delta - Delta C ||^2``.
        orientation: ``sum_f || C Omega_f -+ Omega_g C ||^2``.
    """

    descriptors: float = 1.0
    products: float = 10.0
    laplacian: float = 1.0
    orientation: float = 1.0


def orientation_operators(shape: PreparedShape, values: Float[Tensor, "V N"], k: int) -> Float[Tensor, "N K K"]:
    """``Omega_f`` of each descriptor f in the first k eigenfunctions: ``<phi_i, n . (grad f x grad phi_j)>``.

    Args:
        shape: consistently oriented.
        values: ``(V, N)`` the descriptors.
        k: functions.
    """
    evecs = shape.basis.evecs[:, :k]
    pairs = torch.stack([torch.zeros(k, dtype=torch.int64), torch.arange(1, k + 1)])
    # One descriptor at a time: all at once would be a (F, N K) array.
    found = [
        orientation_coefficients(shape.mesh, torch.cat([f[:, None], evecs], 1), pairs, evecs) for f in values.unbind(1)
    ]
    return torch.stack(found)


def _products(basis: SpectralBasis, values: Float[Tensor, "V N"]) -> Float[Tensor, "N K K"]:
    """``M_f`` of each descriptor: ``<phi_i, f phi_j>``."""
    return torch.stack([basis.coefficients(f[:, None] * basis.evecs) for f in values.unbind(1)])


def _commutator(at_x: Operators, at_y: Operators) -> Float[Tensor, "P P"]:
    """The quadratic form of ``sum_i || C X_i - Y_i C ||^2`` on C, row after row.

    With ``vec(C X) = (I (x) X^T) vec C`` and ``vec(Y C) = (Y (x) I) vec C``.
    """
    n_x, n_y = at_x.shape[1], at_y.shape[1]
    one_x, one_y = torch.eye(n_x, dtype=at_x.dtype), torch.eye(n_y, dtype=at_x.dtype)
    mixed = torch.einsum("iab,icd->acbd", at_y, at_x).reshape(n_x * n_y, n_x * n_y)
    squares = torch.kron(one_y, (at_x @ at_x.mT).sum(0)) + torch.kron((at_y.mT @ at_y).sum(0), one_x)
    return squares - mixed - mixed.T


def orientation_fmap(
    x: PreparedShape,
    y: PreparedShape,
    k: int = 8,
    reversing: bool = False,
    weights: OrientationWeights | None = None,
    n_descriptors: int = 100,
    n_operators: int = 20,
    k_descriptors: int = 200,
) -> Float[Tensor, "Ky Kx"]:
    """The functional map that keeps (or turns over) the orientation, functions on x to functions on y.

    Args:
        x: source, consistently oriented.
        y: target, likewise; it may be the source itself.
        k: eigenfunctions.
        reversing: turn the orientation over.
        weights: of the terms.
        n_descriptors: energies of the wave kernel signature; their means are taken off.
        n_operators: how many of them, evenly chosen, make operators.
        k_descriptors: eigenfunctions in the descriptors, at most.

    Raises:
        MatchError: a shape that is not oriented, or too few eigenfunctions.
    """
    for shape in (x, y):
        if not shape.oriented:
            raise MatchError(f"{shape.mesh.label}: not consistently orientable, so a map cannot turn orientation over")
    weights = weights or OrientationWeights()
    k = basis_size([x.basis, y.basis], shared_size(x, y, k))
    small_x, small_y = x.basis.truncate(k), y.basis.truncate(k)
    n_sharp = shared_size(x, y, k_descriptors)
    sharp = [s.basis.truncate(n_sharp) for s in (x, y)]
    energies = wave_energies(sharp, n_descriptors)
    values = [_standard(wave_kernel_signature(basis, energies), basis.mass) for basis in sharp]
    few = [v[:, :: max(1, n_descriptors // n_operators)] for v in values]
    f, g = unit_columns_pair(small_x.coefficients(values[0]), small_y.coefficients(values[1]))
    sign = -1.0 if reversing else 1.0
    scale = torch.maximum(small_x.evals.max(), small_y.evals.max())
    commute = commutativity_weights(small_x.evals / scale, small_y.evals / scale).reshape(-1)
    turned = _commutator(orientation_operators(x, few[0], k), sign * orientation_operators(y, few[1], k))
    fit = torch.kron(torch.eye(k, dtype=f.dtype), f @ f.T)
    terms = (
        (weights.descriptors, fit),
        (weights.products, _commutator(_products(small_x, few[0]), _products(small_y, few[1]))),
        (weights.laplacian, torch.diag(commute)),
        (weights.orientation, turned),
    )
    sizes = [float(term.diagonal().mean()) or 1.0 for _, term in terms]
    system = sum((w / size * term for (w, term), size in zip(terms, sizes, strict=True)), torch.zeros_like(fit))
    # What no term says anything about becomes 0.
    system = system + 1e-9 * torch.eye(k * k, dtype=f.dtype)
    wanted = weights.descriptors / sizes[0] * (g @ f.T).reshape(-1, 1)
    return torch.cholesky_solve(wanted, torch.linalg.cholesky(system)).reshape(k, k)


def _standard(values: Float[Tensor, "V C"], mass: Float[Tensor, " V"]) -> Float[Tensor, "V C"]:
    """Mean 0 and norm 1: the mean says nothing, and would outweigh the rest."""
    centred = values - mass @ values / mass.sum()
    return centred / (mass @ centred.square()).sqrt().clamp_min(torch.finfo(values.dtype).tiny)


@dataclass(frozen=True)
class OrientRev:
    """``orient-rev``: the symmetry of one shape from the orientation-reversing functional map, refined by ZoomOut.

    Give the same shape as source and target; nothing else that is given is used. Chosen on david, cat and centaur poses
    of TOSCA: of 8 to 30 functions 8 (more of them start nearer to the identity), and the weights.

    Args:
        k: functions of the first map.
        k_max: at the end of ZoomOut.
        step: of ZoomOut.
        weights: of the first map's energy.
        name: in tables.
        needs: ``self``: twice the same shape.

    Example:
        >>> from torchqm.data.synthetic import creature
        >>> from torchqm.matching import prepare
        >>> x = prepare(creature("quadruped", 800).mesh, k=40)
        >>> OrientRev().match(x, x).labels
        ('mirrored',)
    """

    k: int = 8
    k_max: int = 100
    step: int = 5
    weights: OrientationWeights = OrientationWeights()
    name: str = "orient-rev"
    needs: tuple[str, ...] = ("self",)

    def match(self, x: PreparedShape, y: PreparedShape, given: Given = NOTHING) -> BaselineResult:
        """The mirror map of a shape; see :class:`torchqm.matching.baselines.Matcher`.

        Raises:
            MatchError: two different shapes, or one that is not oriented.
        """
        if x is not y and x.mesh is not y.mesh:
            raise MatchError(
                f"{self.name}: finds the symmetry of one shape; give the same shape twice, not {x.mesh.label} and "
                f"{y.mesh.label}"
            )
        steps = Steps()
        with steps("orientation-reversing map"):
            fmap = orientation_fmap(x, x, self.k, reversing=True, weights=self.weights)
        k, k_max = fmap.shape[0], shared_size(x, x, self.k_max)
        with steps("ZoomOut"):
            small = x.basis.truncate(k)
            p2p = fmap_to_p2p(fmap, small, small, search=x.search, guide=x.search)
            p2p = zoomout(p2p, x.basis, x.basis, zoomout_sizes(k, k_max, self.step), x.search, x.search)
        notes = [f"basis from {k} to {k_max} functions by {self.step}"]
        label = orientation_label(orientation_agreement(x.mesh, x.mesh, p2p))
        return make_result(self.name, x, x, p2p, steps, (label,), notes, k=k_max)
