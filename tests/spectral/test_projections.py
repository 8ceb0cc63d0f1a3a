"""torchqm.spectral.projections: against torch's products, whatever the sizes, threads and strides."""

import pytest
import torch

from torchqm.native import library
from torchqm.spectral import projections as module
from torchqm.spectral.projections import for_products, project, subtract_


@pytest.fixture(params=["ours", "torch"], autouse=True)
def way(request, monkeypatch):
    """Everything here holds for both."""
    if request.param == "torch":
        monkeypatch.setattr(module, "_built", lambda: None)
    elif library("spectral/_projections") is None:
        pytest.skip("our products are not built here")
    return request.param


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("b", [16, 32, 5])
@pytest.mark.parametrize(("m", "n"), [(1, 1), (3, 7), (8, 256), (9, 263), (40, 2048), (17, 4501)])
def test_as_torch(m, n, b):
    vectors, rows = noise(m, n), noise(b, n, seed=1)
    wanted = vectors @ rows.T
    found = project(vectors, rows)
    torch.testing.assert_close(found, wanted, rtol=1e-13, atol=1e-13 * n**0.5)
    rest = rows - wanted.T @ vectors
    copy = rows.clone()
    assert subtract_(copy, vectors, found) is copy
    torch.testing.assert_close(copy, rest, rtol=1e-12, atol=1e-12 * n**0.5)


def test_rows_around_those_that_are_meant_stay_what_they_were():
    vectors, all_rows = noise(20, 263), noise(48, 263, seed=1)
    before = all_rows.clone()
    subtract_(all_rows[16:32], vectors[3:12], project(vectors[3:12], all_rows[16:32]))
    assert torch.equal(all_rows[:16], before[:16])
    assert torch.equal(all_rows[32:], before[32:])
    assert not torch.equal(all_rows[16:32], before[16:32])


def test_strided_and_single_precision():
    vectors, rows = noise(6, 50), noise(16, 50, seed=1)
    wanted = vectors @ rows.T
    torch.testing.assert_close(project(vectors.T.contiguous().T, rows.T.contiguous().T), wanted, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(project(vectors.float(), rows.float()), wanted.float(), rtol=1e-4, atol=1e-4)


def test_threads_change_nothing_to_the_last_bit(way):
    if way == "torch":
        pytest.skip("torch promises nothing of the kind")
    vectors, rows, before = noise(40, 9000), noise(16, 9000, seed=1), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            products = project(vectors, rows)
            found.append((products, subtract_(rows.clone(), vectors, products)))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, three) for one, three in zip(*found, strict=True))


def test_memory_in_large_pages_is_memory():
    vectors = for_products(torch.empty(3, 2**20, dtype=torch.float64))
    vectors.fill_(2.0)
    assert float(vectors.sum()) == 6 * 2**20


def test_what_does_not_fit_is_refused_and_views_are_what_they_show():
    vectors, rows = noise(5, 50), noise(16, 50, seed=1)
    with pytest.raises(RuntimeError):
        project(vectors[:, :40].contiguous(), rows)
    with pytest.raises(ValueError, match=r"products: \(4, 16\) given, \(5, 16\) expected"):
        subtract_(rows, vectors, noise(4, 16))
    torch.testing.assert_close(project(torch._neg_view(-vectors), rows), vectors @ rows.T)
    assert project(vectors.requires_grad_(), rows).requires_grad
