"""The isometry nearest to a matrix, with a backward pass that does not mind equal singular values."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["nearest_isometry"]


def nearest_isometry(matrix: Float[Tensor, "*B Ky Kx"]) -> Float[Tensor, "*B Ky Kx"]:
    """Replace all singular values by one: ``U S V^T -> U V^T``, the isometry (or co-isometry) nearest to the matrix.

    A square matrix becomes orthogonal. Of a wide one (semi-quotient) the rows become orthonormal: the map is an
    isometry on the complement of its kernel (paper, Lemma 5.1 iii).

    Differentiable, also where singular values are equal, as they all are at an isometry: the derivative of the result
    divides by sums of singular values, never by differences as that of the SVD does. It does not exist where the
    matrix has no full rank; directions whose sum of singular values is below rounding get no gradient.

    Args:
        matrix: ``(..., Ky, Kx)``.

    Example:
        >>> nearest_isometry(torch.tensor([[0.0, -2.0], [0.5, 0.0]])).tolist()
        [[0.0, -1.0], [1.0, 0.0]]
    """
    isometry: Tensor = _Polar.apply(matrix)[0]
    return isometry


class _Polar(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(matrix: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        left, values, right = torch.linalg.svd(matrix, full_matrices=False)
        return left @ right, left, values, right

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*inputs, *output[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Tensor) -> Tensor:
        matrix, left, values, right = ctx.saved_tensors
        return _PolarBackward.apply(grad, matrix, left, values, right)


class _PolarBackward(torch.autograd.Function):
    """Its own function, so that differentiating twice raises instead of leaving the singular vectors out.

    The matrix is not used; it ties the gradient to what it depends on.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(grad: Tensor, matrix: Tensor, left: Tensor, values: Tensor, right: Tensor) -> Tensor:
        inner = left.mT @ grad @ right.mT
        tiny = values[..., :1] * torch.finfo(values.dtype).eps * max(grad.shape[-2:])
        sums = values[..., :, None] + values[..., None, :]
        turn = torch.where(sums > 2 * tiny[..., None], (inner - inner.mT) / sums, 0.0)
        out = left @ turn @ right
        inverse = torch.where(values > tiny, 1 / values, 0.0)
        if left.shape[-2] > left.shape[-1]:  # tall: what leaves the column space
            rest = grad @ (right.mT * inverse[..., None, :])
            out = out + (rest - left @ (left.mT @ rest)) @ right
        elif right.shape[-1] > right.shape[-2]:  # wide: what leaves the row space
            rest = (inverse[..., :, None] * left.mT) @ grad
            out = out + left @ (rest - (rest @ right.mT) @ right)
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> Any:
        raise RuntimeError("nearest_isometry: it can be differentiated once only, not twice")
