"""Eigenpairs: block Lanczos against ARPACK as scipy and pyFM call it, against ARPACK on the same factor, and LOBPCG."""

import statistics
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import torch
from common import RESULTS, peak_mib, write_json

from torchqm.data.synthetic import creature
from torchqm.geometry import Laplacian, Mesh, laplacian, load_mesh, to_scipy
from torchqm.spectral import SpectralBasis, eigenbasis, relative_residuals

Solver = Callable[[Laplacian, int], SpectralBasis]

SCB = {28000: "cat1", 52000: "michael1"}


def mesh_of(size: int, scb: Path | None) -> Mesh:
    """About ``size`` vertices, area 1."""
    if scb is not None and size in SCB:
        return load_mesh(scb / "TOSCA" / "Meshes" / f"{SCB[size]}.off").normalized()
    return creature("quadruped", size, 0, 1, retriangulate=1).mesh.normalized()


def scipy_call(operator: Laplacian, k: int) -> SpectralBasis:
    """What pyFM 1.3 does in ``laplacian_spectrum``, and most code of the field: ``eigsh(W, k, M, sigma=-0.01)``."""
    mass = operator.mass.numpy()
    evals, evecs = spla.eigsh(to_scipy(operator.stiffness).tocsc(), k=k, M=sp.diags_array(mass).tocsc(), sigma=-0.01)
    return SpectralBasis(torch.from_numpy(evals), torch.from_numpy(evecs), operator.mass)


def arpack_with_cholesky(operator: Laplacian, k: int) -> SpectralBasis:
    """The same with the solves of cholespy, one vector at a time as ARPACK asks for them."""
    matrix, root = _scaled(operator)
    factor = _factor(matrix)

    def solve(rhs: np.ndarray) -> np.ndarray:
        found = np.empty_like(rhs)
        factor.solve(rhs, found)
        return found

    inverse = spla.LinearOperator(matrix.shape, matvec=solve, dtype=np.float64)
    evals, evecs = spla.eigsh(matrix, k=k, sigma=-0.01, OPinv=inverse)
    return SpectralBasis(torch.from_numpy(evals), torch.from_numpy(evecs / root[:, None]), operator.mass)


def lobpcg(operator: Laplacian, k: int) -> SpectralBasis:
    """LOBPCG preconditioned by the same factor, to 1e-6 or 200 steps."""
    matrix, root = _scaled(operator)
    factor = _factor(matrix)

    def solve(rhs: np.ndarray) -> np.ndarray:
        rhs = np.ascontiguousarray(rhs)
        found = np.empty_like(rhs)
        factor.solve(rhs, found)
        return found

    inverse = spla.LinearOperator(matrix.shape, matvec=solve, matmat=solve, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal((matrix.shape[0], k))
    evals, evecs = spla.lobpcg(matrix, start, M=inverse, largest=False, tol=1e-6 * 4 * np.pi * k, maxiter=200)
    order = np.argsort(evals)
    return SpectralBasis(
        torch.from_numpy(evals[order]), torch.from_numpy(evecs[:, order] / root[:, None]), operator.mass
    )


def tight(operator: Laplacian, k: int) -> SpectralBasis:
    """Block Lanczos to 1e-9."""
    return eigenbasis(operator, k, tol=1e-9, solver="lanczos")


def loose(operator: Laplacian, k: int) -> SpectralBasis:
    """Block Lanczos to 1e-6."""
    return eigenbasis(operator, k, tol=1e-6, solver="lanczos")


SOLVERS: dict[str, Solver] = {
    "torchqm": eigenbasis,
    "torchqm 1e-6": loose,
    "torchqm 1e-9": tight,
    "scipy eigsh (pyFM's call)": scipy_call,
    "eigsh with cholespy": arpack_with_cholesky,
}
NAME = "torchqm"
REFERENCE = "scipy eigsh (pyFM's call)"


def measure(sizes: list[int], ks: list[int], repeats: int, scb: Path | None) -> None:
    """Every solver on every size and number of pairs; LOBPCG on the middle one, once."""
    cases = []
    for size in sizes:
        mesh = mesh_of(size, scb)
        operator = laplacian(mesh)
        for k in ks:
            solvers = dict(SOLVERS)
            rounds = repeats if size < 40000 else min(repeats, 3)  # 40 s a call
            for solver in solvers.values():
                solver(laplacian(mesh_of(1000, None)), 20)  # imports and first calls
            seconds: dict[str, list[float]] = {name: [] for name in solvers}
            bases: dict[str, SpectralBasis] = {}
            for _ in range(rounds):
                for name, solver in solvers.items():
                    begin = perf_counter()
                    bases[name] = solver(operator, k)
                    seconds[name].append(perf_counter() - begin)
            if (size, k) == (28000, 200):
                begin = perf_counter()
                bases["lobpcg with cholespy"] = lobpcg(operator, k)
                seconds["lobpcg with cholespy"] = [perf_counter() - begin]
            case = {"mesh": mesh.name, "n_verts": mesh.n_verts, "k": k, "repeats": rounds, "solvers": {}}
            slow = statistics.median(seconds[REFERENCE])
            for name, basis in bases.items():
                middle = statistics.median(seconds[name])
                gram = basis.evecs.T @ (basis.mass[:, None] * basis.evecs)
                case["solvers"][name] = {
                    "seconds": middle,
                    "all_seconds": seconds[name],
                    "ratio": slow / middle,
                    "residual_max": float(relative_residuals(operator, basis).max()),
                    "orthogonality": float((gram - torch.eye(k)).abs().max()),
                    "evals_differ": float((basis.evals - bases[REFERENCE].evals).abs().max() / basis.evals[-1]),
                    "peak_mib": peak_mib(solvers[name], operator, k) if name in (NAME, REFERENCE) else None,
                }
                row = case["solvers"][name]
                print(
                    f"{mesh.name} {mesh.n_verts} k={k} {name}: " + str({a: row[a] for a in row if a != "all_seconds"})
                )
            cases.append(case)
    write_json(RESULTS / "speed_eigenpairs.json", {"threads": torch.get_num_threads(), "cases": cases})


def _scaled(operator: Laplacian) -> tuple[sp.csc_array, np.ndarray]:
    root = np.sqrt(operator.mass.numpy())
    scale = sp.diags_array(1 / root)
    return (scale @ to_scipy(operator.stiffness) @ scale).tocsc(), root


def _factor(matrix: sp.csc_array) -> object:
    import cholespy

    shifted = (matrix + 0.01 * sp.eye_array(matrix.shape[0])).tocsc()
    shifted.sort_indices()
    indices = (shifted.indptr.astype(np.int32), shifted.indices.astype(np.int32))
    return cholespy.CholeskySolverD(matrix.shape[0], *indices, shifted.data, cholespy.MatrixType.CSC)
