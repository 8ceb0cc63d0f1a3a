"""torchqm.fmap.polar: the nearest isometry and its derivative, also where all singular values are equal."""

import pytest
import torch

from torchqm.fmap import nearest_isometry
from torchqm.testing import gradcheck64


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("shape", [(4, 4), (5, 3), (3, 5)])
def test_is_an_isometry_and_the_nearest(shape):
    matrix = random(2, *shape)
    nearest = nearest_isometry(matrix)
    gram = nearest @ nearest.mT if shape[0] <= shape[1] else nearest.mT @ nearest
    torch.testing.assert_close(gram, torch.eye(min(shape), dtype=torch.float64).expand_as(gram))
    best = (nearest - matrix).norm()
    for seed in range(5):
        turned = nearest @ torch.linalg.matrix_exp(
            0.1
            * (random(shape[1], shape[1], seed=seed).triu(1) * 1.0).sub(
                (random(shape[1], shape[1], seed=seed).triu(1)).T
            )
        )
        assert float((turned - matrix).norm()) > float(best)


@pytest.mark.parametrize("shape", [(4, 4), (5, 3), (3, 5), (2, 4, 3)])
def test_gradients(shape):
    weights = random(*shape, seed=1)
    gradcheck64(lambda m: (nearest_isometry(m) * weights).sum(), random(*shape))


@pytest.mark.parametrize("shape", [(4, 4), (5, 3), (3, 5)])
def test_gradients_where_all_singular_values_are_equal(shape):
    """The derivative of torch's own SVD is infinite there."""
    isometry = nearest_isometry(random(*shape))
    weights = random(*shape, seed=1)
    gradcheck64(lambda m: (nearest_isometry(m) * weights).sum(), 2 * isometry)


def test_a_singular_matrix_has_finite_gradients():
    matrix = torch.diag(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).requires_grad_()
    nearest_isometry(matrix).sum().backward()
    assert bool(torch.isfinite(matrix.grad).all())


def test_the_second_derivative_is_refused():
    matrix = random(3, 3).requires_grad_()
    (grad,) = torch.autograd.grad(nearest_isometry(matrix)[0, 0], matrix, create_graph=True)
    with pytest.raises(RuntimeError, match="once only"):
        grad.sum().backward()


def test_one_by_one_or_all_at_once():
    matrices = random(3, 4, 4)
    weights = random(4, 4, seed=1)
    loss = lambda m: (nearest_isometry(m) * weights).sum()  # noqa: E731
    together = torch.func.vmap(torch.func.grad(loss))(matrices)
    torch.testing.assert_close(together, torch.stack([torch.func.grad(loss)(m) for m in matrices]))
