"""The first eigenpairs of a shape's Laplacian."""

import warnings

import numpy as np
import scipy
import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits
from torch import Tensor

from torchqm.geometry.laplacian import Laplacian, laplacian, to_scipy
from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.lanczos import BLOCK, LanczosError, lowest_eigenpairs, residual_scale

__all__ = [
    "SOLVERS",
    "TOLERANCE",
    "SpectrumError",
    "SpectrumWarning",
    "eigenbasis",
    "eigenbasis_and_note",
    "fix_signs",
    "mesh_basis",
    "relative_residuals",
]

SOLVERS = ("auto", "dense", "lanczos", "arpack")

TOLERANCE = 1e-8
"""Default bound of the relative residuals. Each digit costs about 5 % more time, see benchmarks/speed.py."""

SHIFT = -1e-2  # of ARPACK, in units of 1/area: below the spectrum, so that W - shift M can be factored
_DENSE_SIZE, _DENSE_MOST = 400, 4000


class SpectrumError(ValueError):
    """The eigenpairs that were asked for cannot be had from this operator."""


class SpectrumWarning(UserWarning):
    """The eigenpairs came from the slower solver; the message says why."""


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


def eigenbasis(
    operator: Laplacian,
    k: int,
    name: str = "mesh",
    *,
    tol: float = TOLERANCE,
    solver: str = "auto",
    device: str | torch.device = "cpu",
) -> SpectralBasis:
    """The ``k`` lowest eigenpairs of ``W phi = lambda M phi``, as exact as ``tol`` says.

    The rule of ``solver="auto"``: up to 400 vertices, and up to 4,000 where they are not three times ``k``, the matrix
    is diagonalised as a dense one; else block Lanczos (:func:`torchqm.spectral.lanczos.lowest_eigenpairs`); and where
    that does not reach ``tol``, ARPACK with a :class:`SpectrumWarning` that gives its numbers. Vertices without mass
    (no face uses them) take no part; their entries in ``evecs`` are zero. Start vectors are fixed: equal input and the
    same number of torch's threads give equal output.

    Args:
        operator: stiffness ``(V, V)`` and lumped mass ``(V,)``.
        k: number of eigenpairs, the constant function included.
        name: what error messages call the shape.
        tol: bound of :func:`relative_residuals`; less is not to be had where ``10 eps |W| / lambda`` is larger.
        solver: ``auto``, ``dense``, ``lanczos`` or ``arpack`` (each alone: an error where it fails).
        device: ``cpu`` or ``cuda``: where block Lanczos works. The other solvers are on the CPU, and so is the result.

    Returns:
        The basis, eigenvalues ascending, signs by :func:`fix_signs`.

    Raises:
        SpectrumError: fewer vertices than ``k``, entries that are not finite, or no convergence (with its numbers).
        ValueError: an unknown ``solver`` or ``device``, one that is not there, or ``tol`` not in ``(0, 1e-3]``.

    Warns:
        SpectrumWarning: block Lanczos did not reach ``tol``; ARPACK was asked.

    References:
        Paper, section 3 (the multiscale basis); Levy and Zhang 2010 for shift-invert.
    """
    basis, note = eigenbasis_and_note(operator, k, name, tol=tol, solver=solver, device=device)
    if note:
        warnings.warn(note, SpectrumWarning, stacklevel=2)
    return basis


def eigenbasis_and_note(
    operator: Laplacian,
    k: int,
    name: str = "mesh",
    *,
    tol: float = TOLERANCE,
    solver: str = "auto",
    device: str | torch.device = "cpu",
) -> tuple[SpectralBasis, str]:
    """The same as :func:`eigenbasis`, with the warning as text; an empty one if there is nothing to say."""
    if solver not in SOLVERS:
        raise ValueError(f"solver: {solver!r} given, allowed are {', '.join(SOLVERS)}")
    if not 0 < tol <= 1e-3:
        raise ValueError(f"tol: {tol} given, allowed is more than 0 and at most 1e-3")
    where = _device(device)
    mass = operator.mass.numpy().astype(np.float64)
    used = np.flatnonzero(mass > 0)
    if k < 1 or k > used.size:
        raise SpectrumError(
            f"{name}: {k} eigenpairs asked for, but the mesh has {used.size} vertices with area; "
            f"allowed are 1..{used.size}"
        )
    # Work at unit area: shifts and tolerances then mean the same for a fly and for a whale.
    area = mass.sum()
    root = np.sqrt(mass[used] / area)
    stiffness = to_scipy(operator.stiffness).tocsr()
    if used.size < mass.size:
        stiffness = stiffness[used][:, used]
    scale = scipy.sparse.diags_array(1 / root)
    matrix = (scale @ stiffness @ scale).tocsc()
    if not (np.isfinite(matrix.data).all() and np.isfinite(area)):
        raise SpectrumError(f"{name}: its Laplacian has entries that are NaN or infinite")
    evals, rows, note = _solve(((matrix + matrix.T) / 2).tocsc(), k, tol, solver, name, where)
    evecs = torch.zeros(mass.size, k, dtype=torch.float64)
    evecs[torch.from_numpy(used)] = (rows / torch.from_numpy(root * np.sqrt(area))).T
    basis = SpectralBasis(torch.from_numpy(np.maximum(evals, 0.0) / area), fix_signs(evecs), operator.mass)
    return basis, note


def _solve(
    matrix: "scipy.sparse.csc_array", k: int, tol: float, solver: str, name: str, device: str
) -> tuple[np.ndarray, Tensor, str]:
    """Eigenvalues ``(k,)`` ascending, eigenvectors as rows ``(k, n)``, and what is to be said about them."""
    n, note = matrix.shape[0], ""
    small = n <= max(_DENSE_SIZE, min(3 * k, _DENSE_MOST))
    if solver == "dense" or (solver == "auto" and (small or k > n - 2 * BLOCK)):
        evals, vectors = scipy.linalg.eigh(matrix.toarray(), subset_by_index=[0, k - 1])
        return evals, torch.from_numpy(np.ascontiguousarray(vectors.T)), note
    if solver != "arpack":
        try:
            # Weyl: the k-th eigenvalue of a surface of area 1 is about 4 pi k.
            pairs = lowest_eigenpairs(matrix, k, tol, 4 * np.pi * k, device=device)
            return pairs.evals, pairs.evecs, note
        except LanczosError as error:
            if solver == "lanczos":
                raise SpectrumError(f"{name}: {error}") from error
            note = f"{name}: {error}; ARPACK was asked, which is slower"
    if k >= n:
        raise SpectrumError(f"{name}: ARPACK finds fewer eigenpairs than there are vertices ({n}); {k} asked for")
    evals, vectors = _shift_invert(matrix, k, name)
    order = np.argsort(evals, kind="stable")
    return evals[order], torch.from_numpy(np.ascontiguousarray(vectors[:, order].T)), note


def _device(given: str | torch.device) -> str:
    """The name of a device that block Lanczos knows and that is there."""
    text = str(given)
    if text != "cpu" and text.split(":")[0] != "cuda":
        raise ValueError(f"device: {text!r} given, allowed are 'cpu' and 'cuda'")
    if text != "cpu" and not torch.cuda.is_available():
        raise ValueError(f"device: {text!r} given, but torch sees no CUDA device here")
    return text


def _shift_invert(matrix: "scipy.sparse.csc_array", k: int, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Shift-invert Lanczos (ARPACK, sparse factorisation): the slow way, one vector at a time."""
    n = matrix.shape[0]
    # SymmetricMode with minimum degree on A + A^T keeps the fill of a Cholesky factor; the default ordering doubles it.
    factor = scipy.sparse.linalg.splu(
        (matrix - SHIFT * scipy.sparse.eye_array(n, format="csc")).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    inverse = scipy.sparse.linalg.LinearOperator((n, n), matvec=factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(n)
    try:
        # ARPACK calls BLAS on vectors: threads only wait for each other there (4 s became 20 on a busy machine).
        with threadpool_limits(1, "blas"):
            return scipy.sparse.linalg.eigsh(
                matrix, k=k, sigma=SHIFT, which="LM", OPinv=inverse, v0=start, ncv=min(n - 1, 2 * k + 20)
            )
    except scipy.sparse.linalg.ArpackNoConvergence as error:
        raise SpectrumError(
            f"{name}: ARPACK found {len(error.eigenvalues)} of {k} eigenpairs ({error}); "
            "ask for fewer, or look at the mesh with check_mesh"
        ) from error


def relative_residuals(operator: Laplacian, basis: SpectralBasis) -> Float[Tensor, " K"]:
    """``|| W phi - lambda M phi ||_{M^-1} / lambda`` of each eigenpair; of constants over the first other."""
    stiffness = to_scipy(operator.stiffness)
    applied = torch.from_numpy(stiffness @ basis.evecs.numpy()) - basis.mass[:, None] * basis.evecs * basis.evals
    weight = torch.where(basis.mass > 0, 1 / basis.mass.clamp_min(1e-300), 0.0)
    norms = (applied.square() * weight[:, None]).sum(0).sqrt()
    return norms / torch.from_numpy(residual_scale(basis.evals.numpy(), 1 / float(basis.mass.sum())))


def mesh_basis(mesh: Mesh, k: int, kind: str = "auto") -> SpectralBasis:
    """Laplacian and eigenpairs of a mesh in one call, in the units of its own vertices.

    Args:
        mesh: the shape.
        k: number of eigenpairs.
        kind: which Laplacian; see :func:`torchqm.geometry.laplacian.laplacian`.
    """
    return eigenbasis(laplacian(mesh, kind), k, mesh.label)
