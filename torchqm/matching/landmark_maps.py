"""Functional maps of a shape to itself from a permutation of its landmarks."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.refine import nearest_isometry
from torchqm.fmap.solve import solve_fmap
from torchqm.matching.initial import basis_size
from torchqm.matching.shape import PreparedShape
from torchqm.symmetry.landmarks import LandmarkPermutation, Landmarks, green_functions
from torchqm.symmetry.orientation import orientation_coefficients

__all__ = ["LandmarkMaps"]


class LandmarkMaps:
    """Least-squares maps between functions that a permutation of landmarks sends to each other.

    Three kinds of functions correspond: the intrinsic descriptors to themselves, the Green's function of each landmark
    to that of its image, and ``omega(G_a, G_b)`` to plus or minus ``omega`` of the images. Everything is computed once
    for a shape; a permutation only reorders columns.

    Args:
        x: the shape.
        landmarks: its landmarks.
        values: ``(V, C)`` its descriptors.
        k: functions of the maps, at most.
        n_smooth: functions in a Green's function.
        powers: of the Green's functions.
    """

    def __init__(
        self,
        x: PreparedShape,
        landmarks: Landmarks,
        values: Float[Tensor, "V C"],
        k: int = 30,
        n_smooth: int = 60,
        powers: tuple[float, ...] = (1.0,),
    ) -> None:
        basis = x.basis.truncate(basis_size([x.basis], k))
        n = landmarks.n
        self.evals = basis.evals
        self.pairs = torch.triu_indices(n, n, 1)
        described = basis.coefficients(values)
        described = described / described.norm(dim=0).clamp_min(1e-300)
        self.described = described / described.shape[1] ** 0.5
        self.green, self.turned = [], []
        for power in powers:
            green = torch.stack([green_functions(x.basis, t, power, n_smooth).mean(1) for t in landmarks.tips], 1)
            coefficients = basis.coefficients(green)
            self.green.append(coefficients / (coefficients.norm(dim=0).mean() * n**0.5))
            if n > 1:
                omega = orientation_coefficients(x.mesh, green / green.abs().amax(), self.pairs, basis.evecs)
                size = omega.norm(dim=0).mean().clamp_min(1e-300) * self.pairs.shape[1] ** 0.5
                self.turned.append(omega / size)

    def solve(
        self, permutation: LandmarkPermutation, described: float = 0.1, turned: float = 1.0, commutativity: float = 1.0
    ) -> Float[Tensor, "K K"]:
        """The orthonormal map of a permutation; an involution if the permutation is one.

        Args:
            permutation: of the landmarks.
            described: weight of the descriptors, where the landmarks have 1. Descriptors of a real pose have a little
                of everything, and what they have of the odd functions pulls these towards the even ones: with a large
                weight the arms of a person are mirrored and the legs are not.
            turned: weight of ``omega``.
            commutativity: weight of commutativity with the Laplacian per basis function.
        """
        images = torch.tensor(permutation.images)
        a, b = images[self.pairs]
        n = len(images)
        number = torch.zeros(n, n, dtype=torch.int64)
        number[self.pairs[0], self.pairs[1]] = torch.arange(self.pairs.shape[1])
        column = number[torch.minimum(a, b), torch.maximum(a, b)]
        sign = permutation.orientation * torch.where(a < b, 1.0, -1.0).to(self.evals.dtype)
        intrinsic = described * self.described
        f = torch.cat([intrinsic, *self.green, *(turned * t for t in self.turned)], 1)
        moved = [*(h[:, images] for h in self.green), *(turned * t[:, column] * sign for t in self.turned)]
        g = torch.cat([intrinsic, *moved], 1)
        if permutation.involutive:
            # With its inverse equal to itself, even and odd parts correspond each to itself and to its negative.
            even, odd = (f + g) / 2, (f - g) / 2
            f, g = torch.cat([even, odd], 1), torch.cat([even, -odd], 1)
        weight = commutativity * float(f.square().sum()) / len(self.evals)
        fmap = solve_fmap(f, g, self.evals, self.evals, weight, ridge=1e-9)
        return _balanced_involution(fmap) if permutation.involutive else nearest_isometry(fmap)


def _balanced_involution(matrix: Float[Tensor, "K K"]) -> Float[Tensor, "K K"]:
    """The nearest involution of which at least half the functions are even, as they are for any symmetry.

    Landmarks say little about some of the functions; noise must not make these odd.
    """
    weights, vectors = torch.linalg.eigh((matrix + matrix.T) / 2)
    n_odd = min(int((weights < 0).sum()), len(weights) // 2)  # by number: weights of a good map are equal, near -1
    return (vectors * torch.where(torch.arange(len(weights)) < n_odd, -1.0, 1.0)) @ vectors.T
