"""torchqm.fmap.cholesky: factors are right, and only what is singular to rounding is called singular."""

import pytest
import torch

from torchqm.fmap.cholesky import factorize, solve_checked, surely_regular


def noise(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def singular(gram, diagonal):
    upper = gram.new_empty(*diagonal.shape, gram.shape[-1])
    failed = factorize(gram, diagonal, upper)
    unit = (gram.diagonal(dim1=1, dim2=2) + diagonal).sqrt()
    return failed | solve_checked(upper, torch.ones_like(diagonal), unit)[1]


@pytest.mark.parametrize("k", [1, 16, 50])
def test_factors_are_those_of_torch(k):
    a = noise(2, k, k + 3)
    gram, diagonal = a @ a.mT, noise(3, 2, k, seed=1).square()
    before, upper = gram.clone(), torch.full((3, 2, k, k), torch.nan, dtype=torch.float64)
    assert not factorize(gram, diagonal, upper).any()
    systems = gram + torch.diag_embed(diagonal)
    torch.testing.assert_close(upper.triu(), torch.linalg.cholesky(systems).mT, atol=1e-12 * k, rtol=1e-12)
    assert torch.equal(gram, before)  # also one row of one sample, where an expanded copy would be a view
    one = torch.empty(1, 1, k, k, dtype=torch.float64)
    factorize(gram[:1], diagonal[:1, :1], one)
    assert torch.equal(gram, before)


def test_an_indefinite_system_is_named():
    gram = torch.eye(40, dtype=torch.float64)[None]
    diagonal = torch.zeros(3, 1, 40, dtype=torch.float64)
    diagonal[1, 0, 20] = -2
    assert factorize(gram, diagonal, torch.empty(3, 1, 40, 40, dtype=torch.float64)).flatten().tolist() == [0, 1, 0]


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
@pytest.mark.parametrize("place", [0, 3])
def test_what_is_no_number_has_no_factor(bad, place):
    gram = torch.eye(4)[None].clone()
    diagonal = torch.zeros(2, 1, 4)
    diagonal[1, 0, place] = bad
    assert factorize(gram, diagonal, torch.empty(2, 1, 4, 4)).flatten().tolist() == [False, True]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("k", "c"), [(4, 20), (30, 64), (60, 256)])
def test_one_missing_dimension_is_seen_whatever_the_scales(dtype, k, c):
    """Also where all pivots are far above rounding, as with some of these seeds."""
    scales = torch.logspace(0, -3, k, dtype=dtype)[:, None]
    for seed in range(30):
        a = noise(k, k - 1, seed=seed, dtype=dtype) @ noise(k - 1, c, seed=seed + 100, dtype=dtype) * scales
        gram = (a @ a.T)[None]
        assert singular(gram, torch.zeros(1, 1, k, dtype=dtype)).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_scales_alone_are_not_singular(dtype):
    scales = torch.logspace(0, -12, 20, dtype=dtype)
    a = noise(20, 60, dtype=dtype)
    gram = (scales[:, None] * (a @ a.T) * scales)[None]
    assert not singular(gram, torch.zeros(1, 1, 20, dtype=dtype)).any()
    assert not singular(torch.zeros_like(gram), scales[None, None].square()).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_eigenvalue_problem_speaks_for_all_rows(dtype):
    """Regular with the least diagonal of all: then each row is, and no row is asked; else nothing is promised."""
    a = noise(1, 12, 20, dtype=dtype)
    rows = noise(9, 1, 12, seed=1, dtype=dtype).square()
    assert surely_regular(a @ a.mT, rows.amin(0))
    few = noise(1, 12, 8, dtype=dtype)  # rank 8
    assert not surely_regular(few @ few.mT, torch.zeros_like(rows[0]))
    assert surely_regular(few @ few.mT, torch.full_like(rows[0], 0.1))
    assert not surely_regular(torch.zeros(1, 12, 12, dtype=dtype), torch.zeros_like(rows[0]))
    assert not surely_regular(a @ a.mT * torch.nan, rows[0])


@pytest.mark.parametrize("seed", range(4))
def test_the_least_diagonal_bounds_the_scaled_eigenvalues_of_all_rows(seed):
    a = noise(1, 6, 7, seed=seed)
    gram = a @ a.mT * noise(6, seed=seed + 10).exp()[:, None] * noise(6, seed=seed + 10).exp()
    rows = noise(40, 1, 6, seed=seed + 20).square() * noise(40, 1, 1, seed=seed + 30).mul(3).exp()

    def least(systems):
        root = systems.diagonal(dim1=-2, dim2=-1).rsqrt()
        return torch.linalg.eigvalsh(root[..., :, None] * systems * root[..., None, :])[..., 0]

    bound = least(gram + torch.diag_embed(rows.amin(0)))
    assert bool((least(gram + torch.diag_embed(rows)) >= bound - 1e-12).all())
