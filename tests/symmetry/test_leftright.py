"""torchqm.symmetry.leftright: two parts of a height function with known peaks, saddle and areas."""

from math import inf

import pytest
import torch
from references.shapes import grid

from torchqm.geometry import Mesh
from torchqm.symmetry import LeftRight, persistence_clusters

SIGN = torch.ones(3, dtype=torch.float64)


def strip(n=31):
    """``[-1.5, 1.5] x [-0.5, 0.5]``, symmetric under half a turn; with n odd no vertex lies on x = 0."""
    mesh = grid(n, 10, 3.0, 1.0)
    return mesh.moved(mesh.verts - torch.tensor([1.5, 0.5, 0.0], dtype=torch.float64))


def dumbbell(mesh, left=-0.8, right=0.8, low=0.9):
    """Peaks of height 1 and ``low``, each falling off with the distance from it; where they meet is a ridge."""
    x, y, _ = mesh.verts.T
    return torch.maximum(1 - ((x - left) ** 2 + y * y).sqrt(), low - ((x - right) ** 2 + y * y).sqrt())


def saddle(mesh, height, sign):
    """The highest edge between the two parts, as high as its lower end."""
    i, j = mesh.edges.T
    across = sign[i] * sign[j] < 0
    return float(torch.minimum(height[i], height[j])[across].max())


def test_equal_peaks_give_exact_halves():
    mesh = strip()
    found = persistence_clusters(mesh, dumbbell(mesh, low=1.0))
    assert torch.equal(found.sign * found.sign[0], torch.where(mesh.verts[:, 0] < 0, 1.0, -1.0).double())
    assert found.balance == pytest.approx(1, abs=1e-12)
    assert found.warning is None


@pytest.mark.parametrize(("left", "right", "low"), [(-1.0, 0.6, 1.0), (-0.8, 0.8, 0.7), (-0.7, 1.1, 0.95)])
def test_unequal_peaks(left, right, low):
    mesh = strip(60)
    height = dumbbell(mesh, left, right, low)
    found = persistence_clusters(mesh, height)
    x, y, _ = mesh.verts.T
    on_left = 1 - ((x - left) ** 2 + y * y).sqrt() > low - ((x - right) ** 2 + y * y).sqrt()
    truth = torch.where(on_left, 1.0, -1.0).double()
    truth = truth * float(torch.sign((truth * found.sign).sum()))
    areas = mesh.vertex_areas
    assert float(areas[found.sign != truth].sum()) < 0.05 * mesh.area  # one ring of vertices at the watershed
    first, second = float(areas[found.sign > 0].sum()), float(areas[found.sign < 0].sum())
    assert found.balance == pytest.approx(min(first, second) / max(first, second), abs=1e-12)
    assert found.top == float(height.max())
    peak = float(height[~on_left].max())
    if peak < found.top:
        assert found.persistence[0] == pytest.approx(peak - saddle(mesh, height, found.sign), abs=1e-12)
    assert list(found.persistence) == sorted(found.persistence, reverse=True)


def test_small_peaks_are_merged_and_told():
    mesh = strip(60)
    x, y, _ = mesh.verts.T
    bump = 0.15 * torch.exp(-200 * ((x - 1.2) ** 2 + (y - 0.2) ** 2))
    plain, found = (persistence_clusters(mesh, dumbbell(mesh) + b) for b in (0 * bump, bump))
    assert torch.equal(plain.sign.abs(), found.sign.abs())
    assert float((plain.sign * found.sign).sum().abs()) == mesh.n_verts
    assert len(found.persistence) > len(plain.persistence) or found.persistence[1] > 2 * plain.persistence[1]
    assert found.margin < plain.margin


def test_vertices_without_faces_belong_to_no_part():
    mesh = strip()
    more = Mesh(torch.cat([mesh.verts, torch.zeros(2, 3, dtype=torch.float64)]), mesh.faces)
    height = torch.cat([dumbbell(mesh, low=1.0), torch.zeros(2, dtype=torch.float64)])
    found = persistence_clusters(more, height)
    assert found.sign[-2:].tolist() == [0, 0]
    assert bool((found.sign[:-2] != 0).all())
    assert found.balance == pytest.approx(1, abs=1e-12)


def test_one_peak_is_reported():
    mesh = strip()
    found = persistence_clusters(mesh, -mesh.verts.norm(dim=1))
    assert found.persistence == ()
    assert found.balance == 0
    assert found.margin == 0
    assert "one peak only" in found.warning


def test_warning_names_the_numbers():
    good = LeftRight(SIGN, (0.8, 0.2), 1.0, 0.95)
    assert (good.margin, good.warning) == (pytest.approx(4), None)
    assert LeftRight(SIGN, (0.8,), 1.0, 0.95).margin == inf
    assert LeftRight(SIGN, (0.8,), 1.0, 0.95).warning is None
    assert "0.3, 0.25" in LeftRight(SIGN, (0.3, 0.25), 1.0, 0.95).warning
    assert "1.20" in LeftRight(SIGN, (0.3, 0.25), 1.0, 0.95).warning
    uneven = LeftRight(SIGN, (0.8, 0.2), 1.0, 0.5).warning
    assert "0.50" in uneven
    assert "peak" not in uneven
