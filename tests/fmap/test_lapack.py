"""torchqm.fmap.lapack: scipy's own Cholesky in place; other installations and other tensors are told apart."""

from types import SimpleNamespace

import pytest
import scipy.linalg
import torch
from references.unchecked import unchecked

from torchqm.fmap import cholesky, lapack
from torchqm.fmap.lapack import has_lapack, potrf


def systems(n, k, dtype=torch.float64):
    a = torch.randn(n, k, k + 2, dtype=dtype, generator=torch.Generator().manual_seed(0))
    return a @ a.mT


@pytest.mark.parametrize(("dtype", "eps"), [(torch.float32, 2e-6), (torch.float64, 5e-15)])
@pytest.mark.parametrize("k", [1, 2, 31, 100])
def test_the_upper_triangle_is_the_factor_and_nothing_else_changes(dtype, eps, k):
    given = systems(3, k, dtype)
    found = given.clone()
    assert potrf(found).tolist() == [0, 0, 0]
    upper = found.triu()
    assert float((upper.mT @ upper - given).abs().max()) < eps * k * float(given.abs().max())
    assert torch.equal(found.tril(-1), given.tril(-1))


def test_the_minor_that_is_not_positive_is_numbered():
    given = torch.eye(5, dtype=torch.float64).repeat(3, 1, 1)
    given[1, 3, 3] = -1
    given[2, 0, 0] = 0
    assert potrf(given).tolist() == [0, 4, 1]


def test_none_at_all():
    assert potrf(torch.empty(0, 4, 4)).tolist() == []
    assert potrf(torch.empty(2, 0, 0)).tolist() == [0, 0]


@pytest.mark.parametrize(
    "given",
    [
        systems(4, 5)[::2],
        systems(2, 5).mT[:, :4],
        systems(2, 5)[0],
        systems(2, 5).half(),
        systems(2, 5).to("meta"),
        torch._neg_view(systems(2, 5)),
    ],
    ids=["strided", "not square", "no batch", "half", "elsewhere", "negated"],
)
def test_memory_that_lapack_would_misread_is_refused(given):
    with pytest.raises(ValueError, match="systems: "):
        unchecked(potrf)(given)


def test_autograd_sees_that_memory_has_changed():
    given = systems(1, 3).requires_grad_()
    square = given * 1
    total = square.square().sum()
    potrf(square.detach())
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        total.backward()


@pytest.mark.parametrize("capsules", [{}, {"spotrf": None, "dpotrf": None}], ids=["missing", "of another signature"])
def test_without_it_torch_factors_the_same(capsules, monkeypatch):
    """A scipy whose integers have 64 bits, or without the module's table."""
    if capsules:
        real = scipy.linalg.cython_lapack.__pyx_capi__
        capsules = {"spotrf": real["sgetrf"], "dpotrf": real["dgetrf"]}
    gram, diagonal = systems(2, 40), torch.rand(3, 2, 40, dtype=torch.float64)
    diagonal[1, 0, 20] = -1e3
    expected = torch.empty(3, 2, 40, 40, dtype=torch.float64)
    failed = cholesky.factorize(gram, diagonal, expected)
    monkeypatch.setattr(scipy.linalg, "cython_lapack", SimpleNamespace(__pyx_capi__=capsules))
    lapack._potrf.cache_clear()
    try:
        assert not has_lapack(gram)
        out = torch.empty_like(expected)
        assert torch.equal(cholesky.factorize(gram, diagonal, out), failed)
        assert failed.tolist() == [[False, False], [True, False], [False, False]]
        good = ~failed
        torch.testing.assert_close(out.triu()[good], expected.triu()[good], atol=1e-12, rtol=1e-12)
    finally:
        lapack._potrf.cache_clear()
