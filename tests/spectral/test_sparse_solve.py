"""torchqm.spectral.sparse_solve: our sweeps and cholespy's against dense inverses, and matrices that have no factor."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.sparse as sp
import torch

from torchqm.native import library
from torchqm.spectral import sparse_solve as module
from torchqm.spectral.sparse_solve import FactorError, factorize

CPU = torch.device("cpu")


@pytest.fixture(params=["ours", "cholespy"], autouse=True)
def way(request, monkeypatch):
    """Everything here holds for both."""
    if request.param == "cholespy":
        monkeypatch.setattr(module, "library", lambda name: None)
    elif library("spectral/_ldl") is None:
        pytest.skip("our solves are not built here")
    return request.param


def grid(n):
    """Laplacian of a grid with a few chords; eigenvalues from zero."""
    line = sp.diags_array([np.ones(n - 1), np.ones(n - 1)], offsets=[-1, 1])
    edges = sp.kronsum(line, line).tolil()
    for i, j in np.random.default_rng(0).integers(0, n * n, (20, 2)):
        edges[i, j] = edges[j, i] = float(i != j)
    edges = sp.csc_array(edges)
    return sp.csc_array(sp.diags_array(edges.sum(0)) - edges)


def noise(*shape):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("rows", [1, 7, 8, 9, 40])
@pytest.mark.parametrize(("centre", "times"), [(0.0, 1), (0.3, 1), (0.3, 2)])
def test_as_the_dense_inverse(rows, centre, times):
    matrix = grid(12)
    factor = factorize(matrix, 0.5, CPU)
    order = slice(None) if factor.order is None else factor.order
    operator = np.linalg.inv(matrix.toarray() + 0.5 * np.eye(144)) - centre * np.eye(144)
    given = noise(rows, 144)
    wanted = given @ torch.from_numpy(np.linalg.matrix_power(operator, times)[order][:, order])
    before = given.clone()
    torch.testing.assert_close(factor.filtered(given, centre, times), wanted, rtol=1e-12, atol=1e-13)
    assert torch.equal(given, before)


def test_threads_and_memory_layout_change_nothing_to_the_last_bit():
    factor, given, before = factorize(grid(12), 0.5, CPU), noise(20, 144), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(factor.filtered(given, 0.3, 2))
            found.append(factor.filtered(given.T.contiguous().T, 0.3, 2))
            found.append(torch.cat([factor.filtered(given[:8], 0.3, 2), factor.filtered(given[8:], 0.3, 2)]))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, found[0]) for one in found)


def test_what_has_no_factor_is_an_error():
    with pytest.raises(FactorError, match="no Cholesky factor"):
        factorize(grid(5), -1.0, CPU)


def test_a_diagonal_matrix_and_one_of_a_single_row():
    for diagonal in ([2.0, 4.0, 5.0], [3.0]):
        factor = factorize(sp.csc_array(sp.diags_array(diagonal)), 1.0, CPU)
        found = factor.filtered(torch.ones(1, len(diagonal), dtype=torch.float64))
        order = range(len(diagonal)) if factor.order is None else factor.order
        assert found[0].tolist() == pytest.approx([1 / (diagonal[i] + 1) for i in order], rel=1e-15)


def test_two_threads_may_use_one_factor():
    factor = factorize(grid(30), 0.5, CPU)
    given = [noise(16, 900) * scale for scale in (1.0, 2.0)]
    expected = [factor.filtered(rows, 0.3, 2) for rows in given]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(20):
            found = list(pool.map(lambda rows: factor.filtered(rows, 0.3, 2), given))
            assert all(torch.equal(one, wanted) for one, wanted in zip(found, expected, strict=True))


@pytest.mark.parametrize("rows", [torch.ones(3, 143).double(), torch.ones(3, 144), torch.ones(144).double()])
def test_rows_of_another_kind_are_refused(rows, way):
    if way == "cholespy":
        pytest.skip("cholespy says so in its own words")
    with pytest.raises(ValueError, match=r"rows: .* given, expected \(m, 144\), torch.float64 on cpu"):
        factorize(grid(12), 0.5, CPU).filtered(rows)


def test_without_qdldl_cholespy_is_asked(monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    assert factorize(grid(5), 0.5, CPU).order is None
