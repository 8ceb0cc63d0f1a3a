"""Helpers for tests of one's own layers: bases up to their gauge, double precision gradients, maps up to symmetry."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["assert_orbit_equal", "basis_allclose", "gradcheck64"]


def basis_allclose(
    a: Float[Tensor, "V K"],
    b: Float[Tensor, "V K"],
    evals: Float[Tensor, " K"],
    mass: Float[Tensor, " V"],
    atol: float = 1e-6,
    rtol: float = 1e-3,
) -> bool:
    """Whether two eigenbases agree up to sign, and up to rotation inside each cluster of equal eigenvalues.

    In each cluster the orthogonal R that minimises ``|| a R - b ||`` is taken, and every column of ``a R - b`` must
    have a norm (in the mass) of at most ``atol``.

    Args:
        a: ``(V, K)`` orthonormal columns, eigenvalues ascending.
        b: ``(V, K)`` the basis to compare.
        evals: ``(K,)`` their eigenvalues, ascending. If a cluster goes on beyond K, cut both bases before it
            (:func:`torchqm.spectral.basis.cluster_end`): its first functions alone are not determined.
        mass: ``(V,)`` vertex areas; vertices without area are not compared.
        atol: largest distance of a column, where columns have norm 1.
        rtol: neighbouring eigenvalues belong to one cluster if they differ by at most this share of the larger.

    Returns:
        True if they agree; also False where a column holds NaN.

    Raises:
        ValueError: the shapes do not fit each other.

    Example:
        >>> a = torch.eye(3, dtype=torch.float64)
        >>> b = -a[:, [0, 2, 1]]
        >>> mass = torch.ones(3, dtype=torch.float64)
        >>> basis_allclose(a, b, torch.tensor([0.0, 2.0, 2.0], dtype=torch.float64), mass)
        True
        >>> basis_allclose(a, b, torch.tensor([0.0, 2.0, 3.0], dtype=torch.float64), mass)
        False
    """
    if a.shape != b.shape:
        raise ValueError(f"a has shape {tuple(a.shape)}, b has {tuple(b.shape)}: they must agree")
    if evals.shape != a.shape[1:] or mass.shape != a.shape[:1]:
        raise ValueError(
            f"evals {tuple(evals.shape)} and mass {tuple(mass.shape)} do not fit a basis of shape {tuple(a.shape)}"
        )
    root = mass.sqrt()[:, None]
    first, second = (torch.where(root > 0, root * side, 0.0) for side in (a, b))
    if not bool(torch.isfinite(first).all() & torch.isfinite(second).all()):
        return False
    ends = [k for k in range(1, len(evals)) if evals[k] - evals[k - 1] > rtol * evals[k].abs()]
    for start, stop in zip([0, *ends], [*ends, len(evals)], strict=True):
        left, _, right = torch.linalg.svd(first[:, start:stop].T @ second[:, start:stop])
        gap = first[:, start:stop] @ (left @ right) - second[:, start:stop]
        if float(gap.norm(dim=0).amax()) > atol:
            return False
    return True


def gradcheck64(fn: Callable[..., Any], *inputs: Any, atol: float = 1e-6, rtol: float = 1e-4) -> bool:
    """Compare a function's gradients with finite differences, in double precision.

    Floating point tensors among the inputs are copied to float64 and differentiated with respect to; all other inputs
    (integer tensors, numbers, objects) are passed as they are.

    Args:
        fn: returns a tensor or a tuple of tensors.
        *inputs: its arguments, by position.
        atol: absolute tolerance of :func:`torch.autograd.gradcheck`.
        rtol: relative tolerance.

    Returns:
        True.

    Raises:
        torch.autograd.gradcheck.GradcheckError: the gradients differ, with both Jacobians.
        ValueError: no input is a floating point tensor.

    Example:
        >>> gradcheck64(lambda x, k: (x**k).sum(), torch.tensor([1.0, 2.0]), 3)
        True
    """
    ready = [
        x.detach().to(torch.float64).clone().requires_grad_() if isinstance(x, Tensor) and x.is_floating_point() else x
        for x in inputs
    ]
    if not any(isinstance(x, Tensor) and x.requires_grad for x in ready):
        raise ValueError("inputs: none is a floating point tensor, so there is no gradient to check")
    return bool(torch.autograd.gradcheck(fn, tuple(ready), atol=atol, rtol=rtol))


def assert_orbit_equal(p2p_a: Int[Tensor, " N"], p2p_b: Int[Tensor, " N"], orbits: Int[Tensor, "V G"]) -> None:
    """Assert that two maps to a symmetric shape agree up to its symmetry, point by point.

    Args:
        p2p_a: ``(N,)`` vertex ids on the target.
        p2p_b: ``(N,)`` vertex ids on the target.
        orbits: ``(V, G)`` orbits of the target's vertices (``SymmetryGroup.orbits``).

    Raises:
        AssertionError: some point's two images lie in different orbits; says how many and shows the first.

    Example:
        >>> orbits = torch.tensor([[0, 1], [1, 0], [2, 2]])
        >>> assert_orbit_equal(torch.tensor([0, 2, 1]), torch.tensor([1, 2, 1]), orbits)
    """
    if p2p_a.shape != p2p_b.shape:
        raise AssertionError(f"the maps have {p2p_a.shape[0]} and {p2p_b.shape[0]} points")
    wrong = (orbits[p2p_a] != p2p_b[:, None]).all(1).nonzero().flatten()
    if len(wrong):
        x = int(wrong[0])
        raise AssertionError(
            f"{len(wrong)} of {p2p_a.shape[0]} points have images in different orbits; the first is point {x}: "
            f"{int(p2p_a[x])} (orbit {orbits[p2p_a[x]].tolist()}) against {int(p2p_b[x])}"
        )
