"""torchqm.fmap.compiled: against dense solves, what it calls singular, any alignment, and where it is missing."""

import pytest
import torch

from torchqm import native
from torchqm.fmap import compiled
from torchqm.fmap.cholesky import factorize, noise, solve_checked
from torchqm.fmap.compiled import kernel_for

CPU = torch.device("cpu")

pytestmark = pytest.mark.skipif(kernel_for(CPU, torch.float32) is None, reason="no compiled kernel here")


def problem(n, ky, kx, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shapes = ((n, kx, kx + 2), (n, ky, kx), (n, ky, kx))
    a, d, r = (torch.randn(shape, generator=generator, dtype=dtype) for shape in shapes)
    return a @ a.mT, d.square(), r


def dense(gram, diagonal, rhs):
    systems = gram[:, None].double() + torch.diag_embed(diagonal.double())
    return torch.linalg.solve(systems, rhs.double())


@pytest.mark.parametrize(("dtype", "eps"), [(torch.float32, 3e-7), (torch.float64, 5e-16)])
@pytest.mark.parametrize(("ky", "kx"), [(1, 1), (3, 2), (4, 3), (8, 4), (9, 5), (17, 31), (20, 64), (1, 100)])
def test_as_dense_solves_with_the_factor_and_without(dtype, eps, ky, kx):
    gram, diagonal, rhs = problem(3, ky, kx, dtype)
    kernel, wanted = kernel_for(CPU, dtype), dense(gram, diagonal, rhs)
    condition = float(torch.linalg.cond(gram[:, None].double() + torch.diag_embed(diagonal.double())).max())
    bound = kx**0.5 * eps * condition * float(wanted.norm())
    rows, undetermined, factor = kernel.solve(gram, diagonal, rhs, noise(gram), keep=True)
    assert not undetermined.any()
    assert factor.shape == kernel.factor_shape(3, ky, kx)
    assert float((rows - wanted).norm()) < bound
    assert torch.equal(kernel.solve(gram, diagonal, rhs, 0.0, keep=False)[0], rows)
    assert torch.equal(kernel.solve_again(factor, rhs), rows)
    other = torch.randn(rhs.shape, dtype=dtype, generator=torch.Generator().manual_seed(7))
    wanted = dense(gram, diagonal, other)
    assert float((kernel.solve_again(factor, other) - wanted).norm()) < kx**0.5 * eps * condition * float(wanted.norm())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shift", [1, 3])
@pytest.mark.parametrize(("ky", "kx"), [(5, 7), (8, 8)])
def test_nothing_around_its_results_is_written_and_any_alignment_will_do(dtype, shift, ky, kx):
    """Memory that starts in the middle of a vector register, between two walls."""
    given = problem(2, ky, kx, dtype)
    kernel = kernel_for(CPU, dtype)
    rows, _, factor = kernel.solve(*given, noise(given[0]), keep=True)

    def walled(like):
        room = torch.full((shift + like.numel() + 16,), 7.0).to(like.dtype)
        return room, room[shift : shift + like.numel()].view(like.shape)

    fine = torch.ones(2, ky, dtype=torch.uint8)
    rooms, inside = zip(*(walled(like) for like in (*given, rows, factor, fine, rows)), strict=True)
    for target, source in zip(inside, given, strict=False):
        target.copy_(source)
    at = [tensor.data_ptr() for tensor in inside]
    assert kernel._solve(*at[:3], noise(given[0]), 2, kx, ky, 2, *at[3:6]) == 0
    assert kernel._again(at[4], at[2], 2, kx, ky, 2, at[6]) == 0
    for found, wanted in zip(inside, (*given, rows, factor, fine, rows), strict=True):
        assert torch.equal(found, wanted)
    for room, tensor in zip(rooms, inside, strict=True):
        assert bool((room[:shift] == 7).all())
        assert bool((room[shift + tensor.numel() :] == 7).all())


def test_views_are_read_as_what_they_show():
    gram, diagonal, rhs = problem(2, 6, 6)
    kernel = kernel_for(CPU, torch.float64)
    expected, _, factor = kernel.solve(gram, diagonal, rhs, 0.0, keep=True)
    strided = torch.stack([rhs, -rhs], -1)[..., 0]
    assert torch.equal(kernel.solve(gram.mT, diagonal.mT.contiguous().mT, strided, 0.0, keep=False)[0], expected)
    negated = torch._neg_view(-rhs)
    assert torch.equal(kernel.solve(gram, diagonal, negated, 0.0, keep=False)[0], expected)
    assert torch.equal(kernel.solve_again(factor, negated), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("k", "c"), [(4, 20), (30, 64), (60, 256)])
def test_the_same_rows_are_singular_as_for_lapack(dtype, k, c):
    """One dimension is missing, whatever the scales; rows with a diagonal of their own are regular."""
    generator = torch.Generator().manual_seed(k)
    scales = torch.logspace(0, -3, k, dtype=dtype)[:, None]
    a = torch.randn(5, k, k - 1, dtype=dtype, generator=generator) @ torch.randn(
        k - 1, c, dtype=dtype, generator=generator
    )
    gram = (a * scales) @ (a * scales).mT
    diagonal = torch.zeros(5, 11, k, dtype=dtype)
    diagonal[:, 3:6] = gram.diagonal(dim1=-2, dim2=-1)[:, None]
    rhs = torch.ones_like(diagonal)
    undetermined = kernel_for(CPU, dtype).solve(gram, diagonal, rhs, noise(gram), keep=False)[1]
    upper = gram.new_empty(11, 5, k, k)
    entries = diagonal.transpose(0, 1)
    failed = factorize(gram, entries, upper)
    unit = (gram.diagonal(dim1=1, dim2=2) + entries).sqrt()
    assert torch.equal(undetermined.T, failed | solve_checked(upper, rhs.transpose(0, 1), unit)[1])
    assert undetermined.sum(1).tolist() == [8] * 5
    assert not undetermined[:, 3:6].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_scales_alone_are_not_singular(dtype):
    gram, diagonal, rhs = problem(1, 3, 20, dtype)
    scales = torch.logspace(0, -12, 20, dtype=dtype)
    gram = scales[:, None] * gram * scales
    assert not kernel_for(CPU, dtype).solve(gram, 0 * diagonal, rhs, noise(gram), keep=False)[1].any()


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -1e3])
@pytest.mark.parametrize("place", [0, 13, 20])
@pytest.mark.parametrize("checked", [True, False])
def test_what_has_no_factor_is_named_and_leaves_its_neighbours_alone(bad, place, checked):
    gram, diagonal, rhs = problem(2, 11, 21)
    kernel, limit = kernel_for(CPU, torch.float64), noise(gram) if checked else 0.0
    expected = kernel.solve(gram, diagonal, rhs, limit, keep=False)[0]
    diagonal[1, 5, place] = bad
    rows, undetermined, _ = kernel.solve(gram, diagonal, rhs, limit, keep=False)
    assert undetermined.nonzero().tolist() == [[1, 5]]
    fine = ~undetermined
    assert torch.equal(rows[fine], expected[fine])


def test_what_is_below_the_diagonal_is_not_read():
    gram, diagonal, rhs = problem(2, 5, 9)
    kernel = kernel_for(CPU, torch.float64)
    other = gram.triu() + torch.full_like(gram, torch.nan).tril(-1)
    assert torch.equal(
        kernel.solve(other, diagonal, rhs, noise(gram), keep=False)[0],
        kernel.solve(gram, diagonal, rhs, noise(gram), keep=False)[0],
    )


@pytest.mark.parametrize("team", [True, False], ids=["torch's threads", "its own"])
def test_more_threads_than_groups_change_nothing(team, monkeypatch):
    """Torch's OpenMP threads, and those it starts where there is no OpenMP."""
    gram, diagonal, rhs = problem(2, 9, 20, torch.float32)
    expected, before = (
        kernel_for(CPU, torch.float32).solve(gram, diagonal, rhs, noise(gram), keep=True),
        torch.get_num_threads(),
    )
    monkeypatch.setattr(compiled, "_WORTH_THREADS", {"again": 0, "anew": 0})
    if not team:
        monkeypatch.setattr(native, "_TEAM", "no such function")
    native.library.cache_clear()
    try:
        torch.set_num_threads(7)
        kernel = compiled._kernels()[torch.float32]
        found = kernel.solve(gram, diagonal, rhs, noise(gram), keep=True)
        assert all(torch.equal(ours, wanted) for ours, wanted in zip(found, expected, strict=True))
        assert torch.equal(kernel.solve_again(found[2], rhs), expected[0])
    finally:
        torch.set_num_threads(before)
        monkeypatch.undo()
        native.library.cache_clear()
        compiled._kernels()  # torch's threads again


def test_tensors_elsewhere_or_of_other_sizes_are_refused():
    gram, diagonal, rhs = problem(2, 9, 20)
    kernel = kernel_for(CPU, torch.float64)
    with pytest.raises(ValueError, match="rhs: is on meta, the others on the CPU"):
        kernel.solve(gram, diagonal, rhs.to("meta"), 0.0, keep=False)
    with pytest.raises(ValueError, match=r"shapes \[\(2, 20, 20\), \(2, 8, 20\), \(2, 9, 20\)\] given"):
        kernel.solve(gram, diagonal[:, :8], rhs, 0.0, keep=False)


def test_a_factor_of_other_sizes_is_refused():
    gram, diagonal, rhs = problem(2, 9, 20)
    kernel = kernel_for(CPU, torch.float64)
    factor = kernel.solve(gram, diagonal, rhs, 0.0, keep=True)[2]
    with pytest.raises(ValueError, match=r"factor: \(2, 3, 960\) given, \(2, 3, 640\) expected"):
        kernel.solve_again(factor, rhs[..., :16])


@pytest.mark.parametrize("what", [(torch.device("meta"), torch.float32), (CPU, torch.half)])
def test_other_tensors_have_none(what):
    assert kernel_for(*what) is None
