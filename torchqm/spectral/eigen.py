"""The first eigenpairs of a shape's Laplacian."""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits
from torch import Tensor

from torchqm.geometry.laplacian import Laplacian, laplacian, to_scipy
from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis

__all__ = ["SpectrumError", "eigenbasis", "fix_signs", "mesh_basis", "relative_residuals"]

SHIFT = -1e-2  # in units of 1/area: below the spectrum, so that W - shift M can be factored


class SpectrumError(ValueError):
    """The eigenpairs that were asked for cannot be had from this operator."""


def fix_signs(evecs: Float[Tensor, "V K"]) -> Float[Tensor, "V K"]:
    """Choose the sign of each column: its entry of largest magnitude is positive.

    Of several that are equally large up to 1e-4 the first one counts: on a symmetric shape an odd function takes its
    largest value twice, with both signs, and rounding must not choose between them.

    Example:
        >>> fix_signs(torch.tensor([[1.0], [-2.0]])).T
        tensor([[-1.,  2.]])
    """
    size = evecs.abs()
    peak = (size >= (1 - 1e-4) * size.amax(0)).int().argmax(0)
    sign = torch.sign(evecs[peak, torch.arange(evecs.shape[1])])
    return evecs * torch.where(sign == 0, 1.0, sign)


def eigenbasis(operator: Laplacian, k: int, name: str = "mesh") -> SpectralBasis:
    """The ``k`` lowest eigenpairs of ``W phi = lambda M phi`` by shift-invert Lanczos (ARPACK, sparse factorisation).

    Vertices without mass (no face uses them) take no part; their entries in ``evecs`` are zero. Below 200 vertices,
    or with at most 12 more than ``k``, the dense solver is used. The start vector is fixed, so equal input gives
    equal output.

    Args:
        operator: stiffness ``(V, V)`` and lumped mass ``(V,)``.
        k: number of eigenpairs, the constant function included.
        name: what error messages call the shape.

    Returns:
        The basis, eigenvalues ascending, signs by :func:`fix_signs`.

    Raises:
        SpectrumError: fewer vertices than ``k``, or ARPACK does not converge (with its numbers).

    References:
        Paper, section 3 (the multiscale basis); Levy and Zhang 2010 for shift-invert.
    """
    mass = operator.mass.numpy().astype(np.float64)
    used = np.flatnonzero(mass > 0)
    if k < 1 or k > used.size:
        raise SpectrumError(
            f"{name}: {k} eigenpairs asked for, but the mesh has {used.size} vertices with area; "
            f"allowed are 1..{used.size}"
        )
    # Work at unit area: the shift and ARPACK's tolerances then mean the same for a fly and for a whale.
    area = mass.sum()
    root = np.sqrt(mass[used] / area)
    stiffness = to_scipy(operator.stiffness).tocsr()[used][:, used]
    scale = sp.diags_array(1 / root)
    matrix = (scale @ stiffness @ scale).tocsc()
    matrix = (matrix + matrix.T) / 2
    if used.size <= k + 12 or used.size < 200:
        evals, vectors = np.linalg.eigh(matrix.toarray())
        evals, vectors = evals[:k], vectors[:, :k]
    else:
        evals, vectors = _shift_invert(matrix.tocsc(), k, name)
    order = np.argsort(evals, kind="stable")
    full = np.zeros((mass.size, k))
    full[used] = vectors[:, order] / root[:, None] / np.sqrt(area)
    evecs = fix_signs(torch.from_numpy(full))
    return SpectralBasis(torch.from_numpy(np.maximum(evals[order], 0.0) / area), evecs, operator.mass)


def _shift_invert(matrix: sp.csc_array, k: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    n = matrix.shape[0]
    # SymmetricMode with minimum degree on A + A^T keeps the fill of a Cholesky factor; the default ordering doubles it.
    factor = spla.splu(
        (matrix - SHIFT * sp.eye_array(n, format="csc")).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    inverse = spla.LinearOperator((n, n), matvec=factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(n)
    try:
        # ARPACK calls BLAS on vectors: threads only wait for each other there (4 s became 20 on a busy machine).
        with threadpool_limits(1, "blas"):
            return spla.eigsh(matrix, k=k, sigma=SHIFT, which="LM", OPinv=inverse, v0=start, ncv=min(n - 1, 2 * k + 20))
    except spla.ArpackNoConvergence as error:
        raise SpectrumError(
            f"{name}: ARPACK found {len(error.eigenvalues)} of {k} eigenpairs ({error}); "
            "ask for fewer, or look at the mesh with check_mesh"
        ) from error


def relative_residuals(operator: Laplacian, basis: SpectralBasis) -> Float[Tensor, " K"]:
    """``|| W phi - lambda M phi ||_{M^-1} / lambda`` for each eigenpair (for the constant one over ``lambda_1``)."""
    stiffness = to_scipy(operator.stiffness)
    applied = torch.from_numpy(stiffness @ basis.evecs.numpy()) - basis.mass[:, None] * basis.evecs * basis.evals
    weight = torch.where(basis.mass > 0, 1 / basis.mass.clamp_min(1e-300), 0.0)
    norms = (applied.square() * weight[:, None]).sum(0).sqrt()
    return norms / basis.evals.clamp_min(basis.evals[1:2].min() if basis.k > 1 else 1.0)


def mesh_basis(mesh: Mesh, k: int, kind: str = "auto") -> SpectralBasis:
    """Laplacian and eigenpairs of a mesh in one call, in the units of its own vertices.

    Args:
        mesh: the shape.
        k: number of eigenpairs.
        kind: which Laplacian; see :func:`torchqm.geometry.laplacian.laplacian`.
    """
    return eigenbasis(laplacian(mesh, kind), k, mesh.label)
