"""From functional maps to point maps and back (paper, section 4.4)."""

from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.nearest import nearest_rows
from torchqm.fmap.surface_search import SurfaceSearch
from torchqm.fmap.threads import in_parallel, shares
from torchqm.spectral.basis import SpectralBasis

__all__ = ["deltas", "fmap_to_p2p", "nearest_used", "p2p_to_fmap"]

_ROWS = 2048  # of a block of vertices


def deltas(basis: SpectralBasis, time: float = 0.0) -> Float[Tensor, "V K"]:
    """Row x holds the coefficients of ``delta_{x,t}``, the heat that has spread from x for a time t.

    ``<delta_{x,t}, phi_i> = exp(-lambda_i t) phi_i(x)``. In a basis of symmetric functions these are the
    symmetrised deltas ``delta_+^{x,t}`` of the paper: the projection needs no extra work.

    Args:
        basis: eigenfunctions of the full space or of L2+.
        time: diffusion time t >= 0, in units of area; 0 gives the (band-limited) Dirac deltas.

    References:
        Paper, section 4.2.
    """
    if time < 0:
        raise ValueError(f"time={time}: heat does not flow backwards; give 0 or more")
    return basis.evecs if time == 0 else basis.evecs * torch.exp(-time * basis.evals)


def fmap_to_p2p(
    fmap_xy: Float[Tensor, "Ky Kx"],
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    time: float = 0.0,
    search: SurfaceSearch | None = None,
    guide: SurfaceSearch | None = None,
) -> Int[Tensor, " Vx"]:
    """``T(x) = argmin_y || C delta_{x,t} - delta_{y,t} ||``: the vertex whose delta is nearest to the image of a delta.

    Args:
        fmap_xy: takes functions on x to functions on y.
        basis_x: basis of x with Kx functions (even ones for a map on the quotient).
        basis_y: basis of y with Ky functions. With symmetric functions the result is a *point-to-orbit* map: which
            of the points of an orbit comes back is arbitrary.
        time: diffusion time, as in :func:`deltas`.
        search: a two-stage search on y, several times faster on large meshes and right nearly always; by default all
            vertices are compared.
        guide: that of x, with which the search on y is faster again.

    Returns:
        ``p2p_xy`` ``(Vx,)``: for each vertex of x a vertex of y (always one that a face uses).

    Raises:
        ValueError: the map does not fit the two bases.

    References:
        Paper, section 4.4.
    """
    if fmap_xy.shape != (basis_y.k, basis_x.k):
        raise ValueError(f"fmap_xy: expected shape ({basis_y.k}, {basis_x.k}), got {tuple(fmap_xy.shape)}")
    if search is not None:  # in single precision, as the search itself
        rows, single = deltas(basis_x, time).detach(), fmap_xy.detach().T.float()
        images = torch.empty(len(rows), basis_y.k, dtype=torch.float32)
        in_parallel([partial(_times, rows[part], single, images[part]) for part in shares(len(rows))])
        return search.nearest(images, deltas(basis_y, time), guide)
    images = deltas(basis_x, time) @ fmap_xy.T
    return nearest_used(images, basis_y, time)


def _times(rows: Tensor, single: Tensor, out: Tensor) -> None:
    torch.mm(rows.float(), single, out=out)


def nearest_used(
    images: Float[Tensor, "Q Ky"], basis_y: SpectralBasis, time: float = 0.0, exact: bool = True
) -> Int[Tensor, " Q"]:
    """The vertex of y with area whose delta is nearest to each row of ``images`` (:func:`nearest_rows`)."""
    used = basis_y.mass > 0
    points = deltas(basis_y, time)
    if bool(used.all()):
        return nearest_rows(images, points, exact)
    ids = used.nonzero().flatten()
    return ids[nearest_rows(images, points[ids], exact)]


def p2p_to_fmap(p2p_yx: Int[Tensor, " Vy"], basis_x: SpectralBasis, basis_y: SpectralBasis) -> Float[Tensor, "Ky Kx"]:
    """The pull-back along a point map: ``C f = f o T`` with ``T = p2p_yx``, so ``C = Phi_y^T A_y Phi_x[T]``.

    Args:
        p2p_yx: for each vertex of y a vertex of x.
        basis_x: basis of x.
        basis_y: basis of y.

    Returns:
        ``fmap_xy``: takes functions on x to functions on y.

    References:
        Paper, section 2.
    """
    if p2p_yx.shape[0] != basis_y.n_verts:
        raise ValueError(f"p2p_yx has {p2p_yx.shape[0]} entries, but y has {basis_y.n_verts} vertices")
    # By blocks, so that the functions pulled back never exist at all vertices.
    rows = torch.as_tensor(p2p_yx).split(_ROWS)
    parts = zip(basis_y.evecs.split(_ROWS), basis_y.mass.split(_ROWS), rows, strict=True)
    blocks = [(SpectralBasis(basis_y.evals, evecs, mass), ids) for evecs, mass, ids in parts]
    return torch.stack(in_parallel([partial(_pulled_back, basis_x, block, ids) for block, ids in blocks])).sum(0)


def _pulled_back(basis_x: SpectralBasis, block: SpectralBasis, ids: Tensor) -> Tensor:
    return block.coefficients(basis_x.evecs[ids])
