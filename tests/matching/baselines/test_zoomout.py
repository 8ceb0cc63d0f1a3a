"""torchqm.matching.baselines.zoomout: its fixed point, its two equations, and both variants on another pose."""

import pytest
import torch
from references.pairs import exact_pair

from torchqm.fmap import p2p_to_fmap
from torchqm.geometry import farthest_points
from torchqm.matching import MatchError
from torchqm.matching.baselines import Start, ZoomOut
from torchqm.matching.baselines.zoomout import zoomout, zoomout_on_samples, zoomout_sizes


def test_the_true_map_is_a_fixed_point():
    pair = exact_pair(1)
    assert torch.equal(zoomout(pair.p2p_xy, pair.x.basis, pair.y.basis, [20, 40, 60]), pair.p2p_xy)
    samples = farthest_points(pair.x.mesh, 100)
    fmap = zoomout_on_samples(
        torch.arange(100), pair.x.basis, pair.y.basis, samples, pair.p2p_xy[samples], [20, 40, 60]
    )
    torch.testing.assert_close(fmap, p2p_to_fmap(pair.p2p_xy, pair.y.basis, pair.x.basis), atol=1e-6, rtol=0)


def test_a_low_map_is_enough_to_find_the_exact_one():
    """From the true map at 10 functions, where points are a blur."""
    pair = exact_pair(1)
    x, y = pair.x.basis, pair.y.basis
    blurred = zoomout(pair.p2p_xy, x, y, [10])
    blurred = blurred[torch.where(torch.arange(642) % 3 == 0, blurred.flip(0).argsort(), torch.arange(642))]
    start = float((blurred == pair.p2p_xy).double().mean())
    assert start < 0.8
    assert torch.equal(zoomout(blurred, x, y, zoomout_sizes(10, 60, 5)), pair.p2p_xy)


def test_one_step_is_equations_1_and_2(walkers):
    """Against dense matrices: C = Phi_x^+ Phi_y[T] with areas, T the nearest row, no orthogonal projection."""
    x, y = walkers.x.basis.truncate(25), walkers.y.basis.truncate(25)
    start = torch.randint(walkers.y.n_verts, (walkers.x.n_verts,), generator=torch.Generator().manual_seed(0))
    fmap = x.evecs.T @ torch.diag(x.mass) @ y.evecs[start]
    nearest = torch.cdist(x.evecs, y.evecs @ fmap.T).argmin(1)
    agree = zoomout(start, walkers.x.basis, walkers.y.basis, [25]) == nearest
    assert float(agree.double().mean()) > 0.995  # ties at float32


@pytest.mark.parametrize("n_samples", [None, 300])
def test_another_pose_and_triangulation(walkers, n_samples):
    """Nearest descriptors are above 0.07."""
    found = ZoomOut(n_samples=n_samples).match(walkers.x, walkers.y)
    assert float(walkers.errors(found.best)[0]) < 0.02
    assert ("farthest points" in found.steps) == (n_samples is not None)


def test_bad_sizes(walkers):
    x, y = walkers.x, walkers.y
    with pytest.raises(ValueError, match="up to 90"):
        zoomout(walkers.truth[0], x.basis, y.basis, [90])
    with pytest.raises(ValueError, match="30 samples"):
        zoomout_on_samples(torch.arange(30), x.basis, y.basis, torch.arange(30), torch.arange(30), [20, 40])
    with pytest.raises(ValueError, match="step=0"):
        zoomout_sizes(10, 20, 0)
    assert zoomout_sizes(20, 20, 5) == []
    with pytest.raises(MatchError, match="k_max=15: must be above the 20"):
        ZoomOut(k_max=15).match(x, y)
    with pytest.raises(MatchError, match="n_samples=50: at least as many as the 80"):
        ZoomOut(Start(icp_steps=0), n_samples=50).match(x, y)
