"""Slow twins: what torchqm computes fast, written as the formula says, with loops and dense matrices."""

from math import exp, log

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchqm.geometry import Laplacian, to_scipy
from torchqm.spectral import SpectralBasis
from torchqm.symmetry import SymmetryGroup


def dense_eigenpairs(operator: Laplacian, k: int) -> tuple[Tensor, Tensor]:
    """``W phi = lambda M phi`` by LAPACK's generalised solver."""
    evals, evecs = scipy.linalg.eigh(
        to_scipy(operator.stiffness).toarray(), np.diag(operator.mass.numpy()), subset_by_index=[0, k - 1]
    )
    return torch.from_numpy(evals), torch.from_numpy(evecs)


def wave_kernel_signature(basis: SpectralBasis, log_energies: Tensor, sigma: float) -> Tensor:
    """The formula of Aubry et al., one vertex, energy and eigenpair at a time."""
    out = torch.zeros(basis.n_verts, len(log_energies), dtype=torch.float64)
    for column, energy in enumerate(log_energies.tolist()):
        total = 0.0
        for k in range(1, basis.k):
            weight = exp(-((energy - log(float(basis.evals[k]))) ** 2) / (2 * sigma**2))
            total += weight
            out[:, column] += weight * basis.evecs[:, k] ** 2
        out[:, column] /= total
    return out


def heat_kernel_signature(basis: SpectralBasis, times: Tensor) -> Tensor:
    out = torch.zeros(basis.n_verts, len(times), dtype=torch.float64)
    for column, time in enumerate(times.tolist()):
        trace = sum(exp(-float(e) * time) for e in basis.evals)
        for k in range(basis.k):
            out[:, column] += exp(-float(basis.evals[k]) * time) * basis.evecs[:, k] ** 2 / trace
    return out


def split_descriptors(values: list[Tensor], s: int) -> list[Tensor]:
    """Section 4.1, one value at a time."""
    out = [torch.zeros(v.shape[0], s * v.shape[1], dtype=v.dtype) for v in values]
    for c in range(values[0].shape[1]):
        a = min(float(v[:, c].min()) for v in values)
        b = max(float(v[:, c].max()) for v in values)
        sigma = (b - a) / s
        for m, v in enumerate(values):
            for i in range(1, s + 1):
                for x in range(v.shape[0]):
                    out[m][x, c * s + i - 1] = exp(-((float(v[x, c]) - (a + i * sigma)) ** 2) / sigma**2)
    return out


def solve_fmap(f: Tensor, g: Tensor, mu: Tensor, lam: Tensor, weight: float) -> Tensor:
    """Each row as a stacked least-squares problem, solved by QR instead of the normal equations."""
    rows = []
    for i in range(g.shape[0]):
        system = torch.cat([f.T, weight**0.5 * torch.diag((lam[i] - mu).abs())])
        target = torch.cat([g[i], torch.zeros_like(mu)])
        rows.append(torch.linalg.lstsq(system, target[:, None]).solution[:, 0])
    return torch.stack(rows)


def reynolds(values: Tensor, group: SymmetryGroup) -> Tensor:
    """The mean over each orbit, vertex by vertex."""
    out = torch.zeros_like(values)
    for x in range(values.shape[0]):
        for element in group.maps.tolist():
            out[x] += values[element[x]] / group.order
    return out


def nearest_rows(queries: Tensor, points: Tensor) -> Tensor:
    """All distances of each query, and the first of the least."""
    return torch.stack([((points - q) ** 2).sum(1).argmin() for q in queries])


def icp_step(
    fmap_xy: Tensor,
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    samples: Tensor,
    time: float = 0.0,
    width: float | None = None,
) -> Tensor:
    """One step of quotient-ICP as section 4.3 prints it: a sum of outer products, point by point."""
    decay_x, decay_y = torch.exp(-time * basis_x.evals), torch.exp(-time * basis_y.evals)
    total = torch.zeros_like(fmap_xy)
    for x in samples.tolist():
        source = decay_x * basis_x.evecs[x]
        distance = torch.stack([(decay_y * row - fmap_xy @ source).norm() for row in basis_y.evecs])
        total += torch.outer(decay_y * basis_y.evecs[int(distance.argmin())], source)
    if width is not None:  # not the paper's: damps entries that join far frequencies
        scale = max(float(basis_x.evals[-1]), float(basis_y.evals[-1]))
        for i in range(basis_y.k):
            for j in range(basis_x.k):
                total[i, j] *= exp(-((abs(float(basis_x.evals[j] - basis_y.evals[i])) / scale / width) ** 2))
    u, _, v = torch.linalg.svd(total, full_matrices=False)
    return u @ v


def orientation_coefficients(verts: Tensor, faces: Tensor, f: Tensor, g: Tensor, h: Tensor) -> float:
    """``int h n . (grad f x grad g)`` with gradients in space, one triangle at a time."""
    total = 0.0
    for face in faces.tolist():
        a, b, c = verts[face]
        normal = torch.linalg.cross(b - a, c - a)
        area, normal = normal.norm() / 2, normal / normal.norm()
        gradients = []
        for values in (f[face], g[face]):
            edges = [c - b, a - c, b - a]
            gradients.append(sum(values[k] * torch.linalg.cross(normal, edges[k]) for k in range(3)) / (2 * area))
        total += float(area * normal @ torch.linalg.cross(*gradients) * h[face].mean())
    return total
