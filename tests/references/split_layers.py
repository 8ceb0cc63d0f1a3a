"""Slow twins of the differentiable split: one shape, one element, one pair of eigenvalues at a time."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchqm.spectral import fix_signs


class Halves(NamedTuple):
    evals_even: Tensor
    coeffs_even: Tensor
    evals_odd: Tensor
    coeffs_odd: Tensor


def projection(evecs: Tensor, mass: Tensor, maps: Tensor) -> Tensor:
    """``mean_g Phi^T A Phi[g]`` of one shape, element by element."""
    terms = [evecs.T @ torch.diag(mass) @ evecs[element] for element in maps]
    return sum(terms[1:], terms[0]) / len(terms)


def split(evals: Tensor, projection: Tensor) -> Halves:
    """Lemma 3.1 with torch's own eigh and its gradients: NaN, infinite or noise where two eigenvalues agree."""
    weights, vectors = torch.linalg.eigh((projection + projection.T) / 2)
    found: list[Tensor] = []
    for columns in (vectors[:, weights > 0.5], vectors[:, weights <= 0.5]):
        own, rotation = torch.linalg.eigh(columns.T @ torch.diag(evals) @ columns)
        coeffs = columns @ rotation
        found += [own, fix_signs(coeffs) if coeffs.shape[1] else coeffs]
    return Halves(*found)


def projector(matrix: Tensor, threshold: float) -> Tensor:
    """The sum of ``u u^T`` over eigenvectors above the threshold."""
    out = torch.zeros_like(matrix)
    values, vectors = torch.linalg.eigh((matrix + matrix.T) / 2)
    for value, vector in zip(values, vectors.T, strict=True):
        if value > threshold:
            out += torch.outer(vector, vector)
    return out


def filter_gradient(values: Tensor, vectors: Tensor, grad: Tensor, f, slope, equal_pairs: bool) -> Tensor:
    """Gradient of ``<grad, V f(L) V^T>`` by divided differences (Daleckii and Krein), equal pairs as asked."""
    inner = vectors.T @ (grad + grad.T) / 2 @ vectors
    out = torch.zeros_like(inner)
    for i, a in enumerate(values.tolist()):
        for j, b in enumerate(values.tolist()):
            if i == j or (a == b and equal_pairs):
                out[i, j] = slope(a) * inner[i, j]
            elif a != b:
                out[i, j] = (f(a) - f(b)) / (a - b) * inner[i, j]
    return vectors @ out @ vectors.T
