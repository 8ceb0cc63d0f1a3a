"""torchqm.fmap.rows: against dense solves, derivatives of all orders, under torch.func, and what is kept in memory."""

import subprocess
import sys

import pytest
import torch
from references.unchecked import unchecked
from torch.autograd import forward_ad
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchqm.fmap import cholesky, compiled
from torchqm.fmap import row_operators as module
from torchqm.fmap.compiled import kernel_for
from torchqm.fmap.row_operators import solved_rows
from torchqm.fmap.rows import UndeterminedRowsError, solve_rows
from torchqm.testing import gradcheck64


@pytest.fixture(params=["compiled", "library"], autouse=True)
def way(request, monkeypatch):
    """Everything here holds for both."""
    if request.param == "library":
        monkeypatch.setattr(compiled, "KERNELS", {})
    elif kernel_for(torch.device("cpu"), torch.float64) is None:
        pytest.skip("no compiled kernel here")
    return request.param


def factor_size(way, n, ky, kx):
    """Numbers in the factors of ``ky`` rows of ``n`` samples."""
    if way == "library":
        return n * ky * kx * kx
    return torch.Size(kernel_for(torch.device("cpu"), torch.float64).factor_shape(n, ky, kx)).numel()


def problem(*leading, kx=5, ky=4, c=7, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shapes = ((*leading, kx, c), (*leading, ky, kx), (*leading, ky, kx))
    a, d, r = (torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes)
    return a, d.square(), r


def solve(a, diagonal, rhs, row_chunk=None):
    return solve_rows(a @ a.mT, diagonal, rhs, row_chunk)


@pytest.mark.parametrize("row_chunk", [None, 1, 3])
@pytest.mark.parametrize(
    ("leading", "kx", "ky"), [((), 5, 4), ((2,), 3, 7), ((2, 3), 4, 4), ((2,), 40, 5), ((2,), 4, 0)]
)
def test_as_dense_solves(leading, kx, ky, row_chunk):
    a, d, r = problem(*leading, kx=kx, ky=ky, c=kx + 2)
    a.requires_grad_()  # so that the factor is kept
    systems = (a @ a.mT)[..., None, :, :] + torch.diag_embed(d)
    torch.testing.assert_close(solve(a, d, r, row_chunk), torch.linalg.solve(systems, r), atol=1e-11, rtol=1e-10)


@pytest.mark.parametrize("other", [torch.float32, torch.int64, torch.bool])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_matrix_says_in_which_precision(dtype, other):
    """Right-hand sides and diagonals of other types, as autocast makes them, or whole numbers."""
    a, d, r = (tensor.to(dtype) for tensor in problem(2))
    gram = a @ a.mT
    d, r = d.round().to(other), r.round().to(other)
    found = unchecked(solved_rows)(gram, d, r, 0, True, True, module.is_packed(gram))
    expected = torch.linalg.solve(gram[:, None].double() + torch.diag_embed(d.double()), r.double())
    assert found[0].dtype == found[1].dtype == dtype
    torch.testing.assert_close(found[0].double(), expected, atol=1e-4, rtol=1e-4)
    again = unchecked(module._solve_rows_again)(r, found[1])
    assert again.dtype == dtype
    torch.testing.assert_close(again, found[0])


def test_autocast():
    a, d, r = (tensor.float() for tensor in problem(2))
    gram = (a @ a.mT).requires_grad_()
    with torch.autocast("cpu"):
        rows = solve_rows(gram, d, r.bfloat16())
    assert rows.dtype == torch.float32
    torch.testing.assert_close(rows, solve_rows(gram, d, r.bfloat16().float()))
    (grad,) = torch.autograd.grad(rows.sum(), gram)
    assert bool(torch.isfinite(grad).all())


def test_a_chunk_bounds_the_threads_of_the_kernel(way, threads_of_torch, monkeypatch):
    if way == "library":
        pytest.skip("see test_row_operators")
    threads_of_torch(5)
    asked, kernel = [], kernel_for(torch.device("cpu"), torch.float64)
    real = kernel._solve
    monkeypatch.setattr(kernel, "_solve", lambda *given: asked.append(given[7]) or real(*given))
    for row_chunk in (None, 1, 8, 100):
        solve(*problem(2, kx=6, ky=60), row_chunk)
    assert asked == [5, 1, 2 * 8 // kernel.lanes if kernel.lanes > 3 else 5, 5]


def test_nothing_to_solve():
    empty = torch.zeros(2, 0, 0)
    assert solve_rows(empty, torch.zeros(2, 3, 0), torch.zeros(2, 3, 0)).shape == (2, 3, 0)


@pytest.mark.parametrize("row_chunk", [None, 2])
def test_gradients_and_their_gradients(row_chunk):
    inputs = problem(2, kx=3, ky=3, c=4)
    assert gradcheck64(lambda *given: solve(*given, row_chunk), *inputs)
    tracked = [tensor.requires_grad_() for tensor in inputs]
    assert torch.autograd.gradgradcheck(lambda *given: solve(*given, row_chunk), tracked)


def test_the_gradient_of_a_symmetric_matrix_is_symmetric():
    a, d, r = problem(2)
    gram = (a @ a.mT).requires_grad_()
    systems = ((gram + gram.mT) / 2)[..., None, :, :] + torch.diag_embed(d)
    (expected,) = torch.autograd.grad(torch.linalg.solve(systems, r).square().sum(), gram)
    (found,) = torch.autograd.grad(solve_rows(gram, d, r).square().sum(), gram)
    torch.testing.assert_close(found, expected)


def test_chunks_change_nothing():
    inputs = [tensor.requires_grad_() for tensor in problem(2, kx=40, ky=7, c=50)]
    weight = torch.randn(2, 7, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    found = []
    for row_chunk in (None, 1, 3, 7, 100):
        fmap = solve(*inputs, row_chunk)
        found.append([fmap, *torch.autograd.grad(fmap, inputs, weight)])
    for other in found[1:]:
        for ours, first in zip(other, found[0], strict=True):
            torch.testing.assert_close(ours, first, atol=1e-13, rtol=1e-13)


@pytest.fixture
def threads_of_torch(monkeypatch):
    monkeypatch.setattr(module, "_WORTH_THREADS", 0)
    monkeypatch.setattr(compiled, "_WORTH_THREADS", {"again": 0, "anew": 0})
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("row_chunk", [None, 6])
def test_threads_change_nothing_to_the_last_bit(row_chunk, threads_of_torch, monkeypatch):
    monkeypatch.setitem(cholesky._AT_ONCE, "cpu", 5000)  # more than one part for each
    inputs = [tensor.requires_grad_() for tensor in problem(2, kx=40, ky=9, c=50)]
    weight = torch.randn(2, 9, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    found = []
    for threads in (1, 3):
        threads_of_torch(threads)
        fmap = solve(*inputs, row_chunk)
        found.append([fmap, *torch.autograd.grad(fmap, inputs, weight)])
        assert torch.get_num_threads() == threads
    assert all(torch.equal(one, three) for one, three in zip(*found, strict=True))


@pytest.mark.parametrize("threads", [1, 3])
def test_in_inference_mode(threads, threads_of_torch):
    threads_of_torch(threads)
    inputs = problem(2, kx=6, ky=9)
    expected = solve(*inputs)
    with torch.inference_mode():
        assert torch.equal(solve(*(tensor.clone() for tensor in inputs)), expected)


def test_on_the_cpu_whatever_the_default_device():
    inputs = problem(2)
    expected = solve(*inputs)
    with torch.device("meta"):
        assert torch.equal(solve(*inputs), expected)


@pytest.mark.parametrize("which", range(3))
def test_derivatives_in_forward_mode(which):
    a, diagonal, rhs = problem(2)
    inputs = [a @ a.mT, diagonal, rhs]
    moves = [torch.randn(t.shape, dtype=t.dtype, generator=torch.Generator().manual_seed(8)) for t in inputs]
    moves[0] = moves[0] + moves[0].mT
    steps = [inputs.copy(), inputs.copy()]
    for step, sign in zip(steps, (1, -1), strict=True):
        step[which] = step[which] + sign * 1e-6 * moves[which]
    expected = (solve_rows(*steps[0]) - solve_rows(*steps[1])) / 2e-6
    with forward_ad.dual_level():
        moving = inputs.copy()
        moving[which] = forward_ad.make_dual(inputs[which], moves[which])
        found = forward_ad.unpack_dual(solve_rows(*moving)).tangent
    torch.testing.assert_close(found, expected, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("row_chunk", [None, 1])
def test_hessians_forward_over_reverse_and_reverse_over_forward(row_chunk):
    given = tuple(tensor[0] for tensor in problem(1, kx=3, ky=2, c=4))

    def loss(*inputs):
        return solve(*inputs, row_chunk).pow(3).sum()

    both = torch.func.jacrev(torch.func.jacrev(loss, (0, 1, 2)), (0, 1, 2))(*given)
    for outer, inner in ((torch.func.jacfwd, torch.func.jacrev), (torch.func.jacrev, torch.func.jacfwd)):
        torch.testing.assert_close(outer(inner(loss, (0, 1, 2)), (0, 1, 2))(*given), both, atol=1e-9, rtol=1e-9)


def test_forward_over_forward_is_refused_since_torch_gives_wrong_numbers():
    a, diagonal, rhs = problem(kx=3, ky=2)
    twice = torch.func.jacfwd(torch.func.jacfwd(lambda d: solve(a, d, rhs).sum()))
    with pytest.raises(NotImplementedError, match="take them forward over reverse"):
        twice(diagonal)


def test_traced_and_run_with_other_numbers():
    a, diagonal, rhs = problem(2)
    traced = torch.jit.trace(solve_rows, (a @ a.mT, diagonal, rhs), check_trace=False)
    other = problem(2, seed=1)
    given = (other[0] @ other[0].mT, *other[1:])
    assert torch.equal(traced(*given), solve_rows(*given))


def test_what_is_below_the_diagonal_is_not_used():
    a, diagonal, rhs = problem(2)
    gram = a @ a.mT
    assert torch.equal(
        solve_rows(gram.triu() + 100 * torch.ones_like(gram).tril(-1), diagonal, rhs), solve_rows(gram, diagonal, rhs)
    )


@pytest.mark.parametrize("row_chunk", [None, 2])
def test_under_transforms(row_chunk):
    inputs = problem(3, 2)

    def loss(*given):
        return solve(*given, row_chunk).square().sum()

    tracked = [tensor.clone().requires_grad_() for tensor in inputs]
    expected = torch.autograd.grad(loss(*tracked), tracked)
    each = torch.func.vmap(torch.func.grad(loss, (0, 1, 2)))(*inputs)
    whole = torch.func.grad(lambda *given: torch.func.vmap(loss)(*given).sum(), (0, 1, 2))(*inputs)
    for ours, others, wanted in zip(each, whole, expected, strict=True):
        torch.testing.assert_close(ours, wanted)
        torch.testing.assert_close(others, wanted)
    # one system for several right-hand sides, the batch last
    a, d, r = (tensor[0, 0] for tensor in inputs)
    several = torch.stack([r, 2 * r, -r], -1)
    rows = torch.func.vmap(lambda one: solve(a, d, one, row_chunk), in_dims=-1, out_dims=-1)(several)
    torch.testing.assert_close(rows, solve(a, d, r)[..., None] * torch.tensor([1.0, 2, -1], dtype=torch.float64))
    columns = torch.func.vmap(torch.func.grad(lambda one: loss(a, d, one)), in_dims=-1, out_dims=-1)(several)
    torch.testing.assert_close(columns[..., 2], -torch.func.grad(lambda one: loss(a, d, one))(r))


class Storages(TorchDispatchMode):
    """Notes how much memory the results of all operations share, by address."""

    def __init__(self):
        super().__init__()
        self.sizes = {}

    def __torch_dispatch__(self, function, types, arguments=(), named=None):
        result = function(*arguments, **(named or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, torch.Tensor):
                self.sizes[leaf.untyped_storage().data_ptr()] = leaf.untyped_storage().nbytes()
        return result


@pytest.mark.parametrize("keep", [True, False])
def test_the_factor_is_the_only_tensor_of_its_size(keep, way, monkeypatch):
    """Neither pass makes another; without a backward pass, or in chunks, there is none."""
    a, d, r = problem(2, kx=40, ky=60, c=50)
    whole, gram = 8 * factor_size(way, 2, 60, 40), a @ a.mT
    monkeypatch.setattr("torchqm.fmap.cholesky._AT_ONCE", {"cpu": 2 * 5 * 40 * 40})
    with Storages() as seen:
        _, factor = module._solve_rows(gram, d, r, 0, keep, True, way == "compiled")
    large = [size for size in seen.sizes.values() if size > whole / 10]
    assert large == ([whole] if keep else [])
    if keep:
        with Storages() as seen:
            module._solve_rows_again(r, factor)
        views = [whole] if way == "library" else []  # of the factor
        assert [size for size in seen.sizes.values() if size > whole / 10] == views


@pytest.mark.parametrize(("row_chunk", "tracked", "kept"), [(None, True, 1), (7, True, 0), (None, False, 0)])
def test_what_the_backward_pass_keeps(row_chunk, tracked, kept, way):
    a, d, r = problem(2, kx=10, ky=12, c=20)
    sizes = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: sizes.append(t.numel()) or t, lambda t: t):
        solve_rows((a @ a.mT).requires_grad_(tracked), d, r, row_chunk)
    whole = factor_size(way, 2, 12, 10)
    assert sizes.count(whole) == kept
    assert all(size <= 2 * 12 * 10 for size in sizes if size != whole)


def test_the_backward_pass_makes_nothing_of_that_size(way):
    a, d, r = problem(2, kx=10, ky=12, c=20)
    rows = solve_rows((a @ a.mT).requires_grad_(), d.requires_grad_(), r)
    with Storages() as seen:
        rows.square().sum().backward()
    assert seen.sizes
    assert max(seen.sizes.values()) < 8 * factor_size(way, 2, 12, 10)


def test_undetermined_rows_are_named():
    a, d, r = problem(3, kx=4, ky=3, c=2)  # two descriptors for four unknowns
    d[0], d[1, :2], d[1, 2], d[2] = 1, 1, 0, 1
    with pytest.raises(UndeterminedRowsError, match=r"leave row\(s\) \[2\] of sample 1 of the map") as info:
        solve(a, d, r)
    assert info.value.undetermined.nonzero().tolist() == [[1, 2]]
    with pytest.raises(ValueError, match=r"leave row\(s\) \[2\] of the map"):
        solve(a[1], d[1], r[1], 1)
    with pytest.raises(ValueError, match=r"row\(s\) \[2\] of sample \(1, 0\)"):
        solve(a[:, None], d[:, None], r[:, None])
    with pytest.raises(ValueError, match=r"\[0, 1, 2\] of sample 0, .* of sample 2 of the map"):
        torch.func.vmap(solve)(a, 0 * d, r)
    with pytest.raises(ValueError, match="and rows of 1 more samples"):
        solve(torch.cat([a, a[:1]]), torch.zeros(4, 3, 4).double(), torch.cat([r, r[:1]]))


def test_refusals():
    a, d, r = problem()
    gram = a @ a.mT
    call = unchecked(solve_rows)
    with pytest.raises(ValueError, match=r"diagonal: shape \(4, 4\) given, expected \(Ky, Kx\) with Kx = 5 as in gram"):
        call(gram, d[:, :4], r)
    with pytest.raises(ValueError, match=r"gram: shape \(4, 5\) given, expected"):
        call(gram[:4], d, r)
    with pytest.raises(ValueError, match="row_chunk is 0"):
        call(gram, d, r, 0)
    with pytest.raises(ValueError, match="descriptors has entries that are NaN"):
        call(gram * torch.nan, d, r)
    with pytest.raises(ValueError, match="lmbda and eigenvalues has entries that are NaN"):
        call(gram, d * torch.inf, r)


def test_outside_compiled_code_the_compiler_is_not_loaded_and_the_answer_is_the_operators():
    """Loading it takes seconds, and every first match in a process had to wait for it."""
    code = (
        "import sys, torch; from torchqm.fmap.rows import is_packed, solve_rows\n"
        "g, d = torch.eye(2), torch.tensor([[0.0, 3.0], [3.0, 15.0]])\n"
        "found = solve_rows(g, d, torch.ones(2, 2))\n"
        "loaded = 'torch._dynamo' in sys.modules\n"
        "given = g, d, torch.ones(2, 2), 0, False, True, is_packed(g)\n"
        "print(loaded, torch.equal(found, torch.ops.torchqm.solve_rows(*given)[0]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
