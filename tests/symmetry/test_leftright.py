"""torchqm.symmetry.leftright: displacement in closed form; two parts of a height function with known peaks."""

from math import inf

import numpy as np
import pytest
import torch
from references.shapes import blob, grid, group_of, icosphere
from references.unchecked import unchecked

from torchqm.geometry import Mesh
from torchqm.symmetry import LeftRight, displacement, halves_of_reflection, persistence_clusters

SIGN = torch.ones(3, dtype=torch.float64)


def reflection_of(mesh, signs=(-1.0, 1.0, 1.0)):
    return group_of(mesh.verts.numpy(), [np.eye(3), np.diag(signs)]).maps[1]


class TestDisplacement:
    @pytest.mark.parametrize("by", ["side", "map"])
    def test_sphere(self, by):
        """``d(x, S x) = 2 asin |x|`` on the unit sphere, within the error of the solver, which falls with the edges."""
        worst = []
        for level in (3, 4):
            ball = icosphere(level)
            x = ball.verts[:, 0]
            found = displacement(ball, reflection_of(ball), side=x if by == "side" else None)
            error = found - 2 * torch.asin(x.abs().clamp(max=1))
            assert float(error.abs().mean()) < 0.02
            worst.append(float(error.abs().max()))
            assert worst[-1] < 0.7 * float(ball.edge_lengths.max())
        assert worst[1] < 0.7 * worst[0]

    @pytest.mark.parametrize("by", ["side", "map"])
    def test_box(self, box, by):
        """Flat sides, so the distances are exact: along a side to the middle, and over the edge from an end."""
        x, y, z = box.mesh.verts.T.abs()
        over_the_edge = 0.7 + torch.minimum(0.5 - y, 0.4 - z)
        wanted = 2 * torch.where(x > 0.7 - 1e-9, over_the_edge, x)
        side = box.mesh.verts[:, 0] if by == "side" else None
        found = displacement(box.mesh, reflection_of(box.mesh), side=side)
        torch.testing.assert_close(found, wanted, atol=1e-9, rtol=0)

    def test_axis_from_the_map_is_the_axis_from_the_side(self):
        """On a bumpy shape, where some vertices lie on the axis and some edges cross it."""
        shape = blob(2)
        mesh, reflection = shape.mesh, shape.group.maps[1]
        assert bool((reflection == torch.arange(642)).any())
        i, j = mesh.edges.T
        assert bool(((reflection[i] == j) & (i != j)).any())
        from_map, from_side = displacement(mesh, reflection), displacement(mesh, reflection, side=mesh.verts[:, 0])
        near = 0.02 * float(mesh.edge_lengths.mean())  # the solver starts from other points of one and the same curve
        torch.testing.assert_close(from_map, from_side, atol=near, rtol=0)
        torch.testing.assert_close(from_map, from_map[reflection], atol=near, rtol=0)  # it is symmetric

    def test_only_the_sign_changes_of_the_side_count(self, box):
        x = box.mesh.verts[:, 0]
        reflection = reflection_of(box.mesh)
        wanted = displacement(box.mesh, reflection, side=x)
        torch.testing.assert_close(displacement(box.mesh, reflection, side=-5 * x), wanted)

    def test_extrinsic_is_the_straight_segment(self):
        shape = blob(2)
        found = displacement(shape.mesh, shape.group.maps[1], "extrinsic")
        torch.testing.assert_close(found, 2 * shape.mesh.verts[:, 0].abs(), atol=1e-12, rtol=0)
        intrinsic = displacement(shape.mesh, shape.group.maps[1])
        assert bool((intrinsic > found - 1e-9).all())

    def test_units(self, box):
        reflection = reflection_of(box.mesh)
        wanted = displacement(box.mesh, reflection)
        for scale in (1e-6, 1e6):
            found = displacement(box.mesh.moved(box.mesh.verts * scale), reflection)
            torch.testing.assert_close(found / scale, wanted)

    def test_vertices_of_no_face_are_not_moved(self, box):
        verts = torch.cat([box.mesh.verts, torch.full((2, 3), 5.0, dtype=torch.float64)])
        reflection = torch.cat([reflection_of(box.mesh), torch.tensor([box.mesh.n_verts + 1, box.mesh.n_verts])])
        found = displacement(Mesh(verts, box.mesh.faces), reflection)
        assert found[-2:].tolist() == [0, 0]
        torch.testing.assert_close(found[:-2], displacement(box.mesh, reflection[:-2]))

    def test_no_axis(self, box):
        """The antipodal map of a box fixes no point; nor does a side of one sign change it."""
        antipodal = reflection_of(box.mesh, (-1.0, -1.0, -1.0))
        for options in ({}, {"side": torch.ones(box.mesh.n_verts, dtype=torch.float64)}):
            with pytest.raises(ValueError, match=r"box: the symmetry map has no axis .* kind='extrinsic'"):
                displacement(box.mesh, antipodal, **options)
        wanted = 2 * box.mesh.verts.norm(dim=1)
        torch.testing.assert_close(displacement(box.mesh, antipodal, "extrinsic"), wanted)

    def test_unknown_kind(self, box):
        with pytest.raises(ValueError, match="kind='biharmonic': allowed are 'intrinsic' and 'extrinsic'"):
            unchecked(displacement)(box.mesh, reflection_of(box.mesh), "biharmonic")


class TestHalvesOfReflection:
    def test_left_right_and_the_axis(self):
        shape = blob(2)
        reflection, x = shape.group.maps[1], shape.mesh.verts[:, 0]
        stays = reflection == torch.arange(642)
        found = halves_of_reflection(shape.mesh, reflection, x)
        assert torch.equal(found, torch.where(stays, 0.0, torch.sign(x)))
        assert torch.equal(found[reflection], -found)

    def test_rounding_decides_nothing_on_the_axis(self):
        shape = blob(2)
        reflection, x = shape.group.maps[1], shape.mesh.verts[:, 0]
        wanted = halves_of_reflection(shape.mesh, reflection, x)
        for shift in (-1e-9, 1e-9):
            assert torch.equal(halves_of_reflection(shape.mesh, reflection, x + shift), wanted)

    def test_symmetric_parts_of_the_side_drop_out(self):
        shape = blob(2)
        reflection, (x, y, z) = shape.group.maps[1], shape.mesh.verts.T
        wanted = halves_of_reflection(shape.mesh, reflection, x)
        assert torch.equal(halves_of_reflection(shape.mesh, reflection, 0.1 * x + 3 * y + z * x * x), wanted)


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
