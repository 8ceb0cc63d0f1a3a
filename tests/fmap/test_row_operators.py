"""torchqm.fmap.row_operators: both ways agree, and LAPACK's keeps to its chunks and threads."""

import os
import subprocess
import sys

import pytest
import torch

from torchqm.fmap import compiled
from torchqm.fmap import row_operators as module
from torchqm.fmap.compiled import kernel_for
from torchqm.fmap.rows import solve_rows
from torchqm.fmap.threads import in_shares


def problem(*leading, kx=5, ky=4, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    shapes = ((*leading, kx, kx + 2), (*leading, ky, kx), (*leading, ky, kx))
    a, d, r = (torch.randn(shape, generator=generator, dtype=dtype) for shape in shapes)
    return a @ a.mT, d.square(), r


@pytest.fixture
def by_library(monkeypatch):
    monkeypatch.setattr(compiled, "KERNELS", {})


@pytest.fixture
def threads_of_torch(monkeypatch):
    monkeypatch.setattr(module, "_WORTH_THREADS", 0)
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize(("row_chunk", "threads"), [(1, 3), (4, 2), (5, 3)])
def test_all_threads_together_keep_to_the_chunk(row_chunk, threads, threads_of_torch, by_library, monkeypatch):
    threads_of_torch(threads)
    asked = []

    def spy(run, parts, n):
        asked.append((n, max(part.stop - part.start for part in parts)))
        in_shares(run, parts, n)

    monkeypatch.setattr(module, "in_shares", spy)
    solve_rows(*problem(2, kx=6, ky=9), row_chunk)
    assert asked
    for n, rows in asked:
        assert n * rows <= row_chunk
        assert n == min(threads, row_chunk)


def test_a_small_problem_starts_no_threads(threads_of_torch, by_library, monkeypatch):
    threads_of_torch(2)
    monkeypatch.setattr(module, "_WORTH_THREADS", 9 * 6**2 + 1)
    asked = []
    monkeypatch.setattr(module, "in_shares", lambda run, parts, n: (asked.append(n), in_shares(run, parts, n)))
    solve_rows(*problem(kx=6, ky=9))
    assert asked == [1]


@pytest.mark.skipif(kernel_for(torch.device("cpu"), torch.float32) is None, reason="no compiled kernel here")
@pytest.mark.parametrize(("dtype", "eps"), [(torch.float32, 1e-5), (torch.float64, 1e-13)])
def test_both_ways_give_the_same_rows_and_gradients(dtype, eps, monkeypatch):
    given = [tensor.requires_grad_() for tensor in problem(3, kx=40, ky=21, dtype=dtype)]
    weight = torch.randn(3, 21, 40, dtype=dtype, generator=torch.Generator().manual_seed(5))
    found = []
    for _ in range(2):
        rows = solve_rows(*given)
        found.append([rows, *torch.autograd.grad(rows, given, weight)])
        monkeypatch.setattr(compiled, "KERNELS", {})
    for ours, expected in zip(*found, strict=True):
        assert (ours - expected).norm() < eps * expected.norm()


def test_a_factor_whose_kernel_is_gone_is_refused(by_library):
    with pytest.raises(ValueError, match="asked of a kernel that is not here"):
        torch.ops.torchqm.solve_rows_again(torch.ones(1, 2, 3), torch.ones(1, 1, 8))


def test_what_the_disk_keeps_of_compiled_code_is_not_taken_with_another_factor(tmp_path):
    """Compiled with the kernel, then without, then with: one folder for all three processes."""
    code = (
        "import sys, torch; from torchqm.fmap import compiled; from torchqm.fmap.rows import solve_rows\n"
        "if sys.argv[1] == 'library': compiled.KERNELS.clear()\n"
        "g = torch.eye(5).requires_grad_()\n"
        "f = torch.compile(lambda g: solve_rows(g, torch.ones(4, 5), torch.ones(4, 5)).sum(), backend='aot_eager')\n"
        "f(g).backward(); print(round(float(g.grad.sum()), 3))"
    )
    environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}
    for way in ("compiled", "library", "compiled"):
        done = subprocess.run(
            [sys.executable, "-c", code, way], env=environment, capture_output=True, text=True, check=False
        )
        assert done.stdout == "-25.0\n", done.stderr
