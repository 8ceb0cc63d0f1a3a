import pytest
import torch
from references.unchecked import unchecked

from torchqm.fmap.alignment import alignment_energy, points_of_blocks
from torchqm.testing import gradcheck64


def _case():
    generator = torch.Generator().manual_seed(0)
    sizes = ((2, 3, 4), (2, 6, 7), (2, 7, 4), (2, 3, 6))
    return [torch.rand(*size, generator=generator, dtype=torch.float64) for size in sizes]


def test_alignment_of_the_pull_back_is_zero_and_of_another_map_the_distance():
    fmap, soft, evecs_x, trans_y = _case()
    pulled = torch.einsum("bky,byx,bxl->bkl", trans_y, soft, evecs_x)
    assert alignment_energy(pulled, soft, evecs_x, trans_y).abs().max() < 1e-24
    expected = torch.stack([torch.linalg.matrix_norm(a) ** 2 for a in fmap - pulled])
    torch.testing.assert_close(alignment_energy(fmap, soft, evecs_x, trans_y), expected)


def test_alignment_gradient():
    gradcheck64(alignment_energy, *_case())


def test_alignment_names_what_does_not_fit():
    fmap, soft, evecs_x, trans_y = _case()
    with pytest.raises(ValueError, match="evecs_x: shape"):
        unchecked(alignment_energy)(fmap, soft, evecs_x[:, 1:], trans_y)
    soft[0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="soft_yx"):
        alignment_energy(fmap, soft, evecs_x, trans_y)


def test_points_of_blocks_as_a_slow_search_and_never_padding():
    generator = torch.Generator().manual_seed(1)
    fmaps = [torch.rand(2, 3, 4, generator=generator), torch.rand(2, 2, 2, generator=generator)]
    xs = [torch.rand(2, 6, 4, generator=generator), torch.rand(2, 6, 2, generator=generator)]
    ys = [torch.rand(2, 8, 3, generator=generator), torch.rand(2, 8, 2, generator=generator)]
    mask = torch.ones(2, 8, dtype=torch.bool)
    mask[1, 5:] = False
    found = points_of_blocks(fmaps, xs, ys, mask)
    for b in range(2):
        for x in range(6):
            gaps = [
                sum(float((c[b] @ u[b, x] - v[b, y]).square().sum()) for c, u, v in zip(fmaps, xs, ys, strict=True))
                for y in range(8 if b == 0 else 5)
            ]
            assert int(found[b, x]) == min(range(len(gaps)), key=gaps.__getitem__)


def test_points_of_blocks_wants_one_basis_for_each_map():
    with pytest.raises(ValueError, match="fmaps_xy: 0 given"):
        points_of_blocks([], [], [])
    with pytest.raises(ValueError, match="1 given, with 2 bases of x and 1 of y"):
        points_of_blocks([torch.eye(2)], [torch.eye(2)] * 2, [torch.eye(2)])
