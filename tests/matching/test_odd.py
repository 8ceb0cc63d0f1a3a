"""torchqm.matching.odd: on exact pairs the odd block is the one of the map that keeps orientation."""

from dataclasses import replace

import pytest
import torch
from references.pairs import exact_pair

from torchqm.fmap import p2p_to_fmap
from torchqm.matching import OddMap, join_blocks, solve_odd
from torchqm.symmetry import symmetrized_basis


class Blocks:
    """Split bases of a pair at 30 functions and the blocks of its known vertex map."""

    def __init__(self, pair):
        self.pair = pair
        self.x = symmetrized_basis(pair.x.basis.truncate(30), pair.group_x)
        self.y = symmetrized_basis(pair.y.basis.truncate(30), pair.group_y)
        self.even = p2p_to_fmap(pair.p2p_yx, self.x.even, self.y.even)
        self.odd = p2p_to_fmap(pair.p2p_yx, self.x.odd, self.y.odd)

    def solve(self, even=None, **options):
        meshes = self.pair.x.mesh, self.pair.y.mesh
        even = self.even if even is None else even
        return solve_odd(*meshes, self.x.even, self.y.even, even, self.x.odd, self.y.odd, **options)


@pytest.fixture(scope="module")
def blocks(either):
    return Blocks(either)


def noise(*shape):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def test_the_odd_block_keeps_orientation(blocks, either):
    """The known vertex map of the pair with a mirrored target turns orientation over: minus its block is wanted."""
    keeps = 1.0 if torch.allclose(either.x.mesh.verts, either.y.mesh.verts[either.p2p_xy]) else -1.0
    found = blocks.solve()
    torch.testing.assert_close(found.fmap, keeps * blocks.odd, atol=1e-8, rtol=0)
    assert found.residual_direct < 1e-8
    assert found.residual_mirrored == pytest.approx(2)
    assert found.separated


def test_turning_the_target_inside_out_turns_the_block_over(blocks):
    found = blocks.solve()
    meshes = blocks.pair.x.mesh, replace(blocks.pair.y.mesh, faces=blocks.pair.y.mesh.faces.flip(1))
    other = solve_odd(*meshes, blocks.x.even, blocks.y.even, blocks.even, blocks.x.odd, blocks.y.odd)
    torch.testing.assert_close(other.fmap, -found.fmap, atol=1e-8, rtol=0)


def test_a_noisy_even_block_still_tells_the_sign(blocks):
    exact = blocks.solve()
    found = blocks.solve(blocks.even + 0.05 * noise(*blocks.even.shape))
    k = found.fmap.shape[0]
    torch.testing.assert_close(found.fmap @ found.fmap.T, torch.eye(k, dtype=torch.float64), atol=1e-10, rtol=0)
    assert float((found.fmap * exact.fmap).sum()) / k > 0.9
    assert 0.01 < found.residual_direct < found.residual_mirrored
    assert found.separated


def test_a_wrong_even_block_is_not_separated(blocks):
    """Signs of the even functions drawn at random: no odd block explains their pairs."""
    signs = torch.where(noise(blocks.even.shape[1]) > 0, 1.0, -1.0).double()
    found = blocks.solve(blocks.even * signs)
    assert found.residual_direct > 0.5


def test_the_number_of_pairs(blocks):
    exact = blocks.solve()
    for n in (6, 10_000):
        torch.testing.assert_close(blocks.solve(n_functions=n).fmap, exact.fmap, atol=1e-7, rtol=0)
    with pytest.raises(ValueError, match="n_functions=2: at least 3"):
        blocks.solve(n_functions=2)


def test_join_blocks_is_the_full_map(blocks):
    full = p2p_to_fmap(blocks.pair.p2p_yx, blocks.x.full, blocks.y.full)
    torch.testing.assert_close(join_blocks(blocks.x, blocks.y, blocks.even, blocks.odd), full, atol=1e-8, rtol=0)
    other = p2p_to_fmap(blocks.pair.group_x.maps[1][blocks.pair.p2p_yx], blocks.x.full, blocks.y.full)
    torch.testing.assert_close(join_blocks(blocks.x, blocks.y, blocks.even, -blocks.odd), other, atol=1e-8, rtol=0)


def test_without_odd_functions_the_even_block_is_all():
    pair = exact_pair(1)
    x = symmetrized_basis(pair.x.basis.truncate(20), pair.group_x)
    y = symmetrized_basis(pair.y.basis.truncate(20), pair.group_y)
    even = p2p_to_fmap(pair.p2p_yx, x.even, y.even)
    none = torch.zeros(0, 0, dtype=torch.float64)
    torch.testing.assert_close(join_blocks(x, y, even, none), even)


@pytest.mark.parametrize(("direct", "other", "clear"), [(1.0, 1.49, False), (1.0, 1.51, True), (1.2, 1.0, False)])
def test_separated(direct, other, clear):
    assert OddMap(torch.zeros(1, 1), direct, other).separated is clear
