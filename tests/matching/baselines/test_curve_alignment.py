"""torchqm.matching.baselines.curve_alignment: axes of known place and length, alignments whose answer is known."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references.shapes import blob, grid, icosphere

from torchqm.geometry import Mesh
from torchqm.matching.baselines.curve_alignment import align_closed, axis_curve


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("height", [0.0, 0.5])
def test_a_circle_on_the_sphere(height):
    """Its length, equal spacing, order around the axis, and values between the ends of an edge."""
    sphere = icosphere(4)
    curve = axis_curve(sphere, sphere.verts[:, 2] - height, 60)
    radius = (1 - height**2) ** 0.5
    assert curve.closed
    assert curve.share == 1.0
    assert curve.length == pytest.approx(2 * math.pi * radius, rel=0.01)
    places = curve.values(sphere.verts)
    torch.testing.assert_close(places[:, 2], torch.full((60,), height, dtype=torch.float64), atol=1e-9, rtol=0)
    angles = torch.atan2(places[:, 1], places[:, 0])
    turns = torch.remainder(angles.roll(-1) - angles + math.pi, 2 * math.pi) - math.pi
    assert bool((turns > 0).all()) or bool((turns < 0).all())
    assert float(turns.abs().sum()) == pytest.approx(2 * math.pi)
    assert float(turns.abs().max()) < 2 * 2 * math.pi / 60
    assert float((sphere.verts[curve.vertices] - places).norm(dim=1).max()) < 0.05


def test_the_longest_piece_is_taken():
    sphere = icosphere(4)
    z = sphere.verts[:, 2]
    curve = axis_curve(sphere, (z - 0.9) * (z - 0.2), 30)
    assert float((curve.values(sphere.verts)[:, 2] - 0.2).abs().max()) < 0.05
    assert curve.share == pytest.approx((1 - 0.04) ** 0.5 / ((1 - 0.04) ** 0.5 + (1 - 0.81) ** 0.5), rel=0.02)


def test_an_open_axis_is_walked_from_end_to_end():
    flat = grid(20, 10, 2.0, 1.0)
    curve = axis_curve(flat, flat.verts[:, 1] - 0.43, 20)
    assert not curve.closed
    along = curve.values(flat.verts)[:, 0]
    steps = along.diff()
    assert int((steps > 0).sum()) >= 9  # out, and straight back where the ends are joined
    assert float(along.max() - along.min()) == pytest.approx(2.0, abs=0.2)


def test_no_axis():
    mesh = blob(2).mesh
    with pytest.raises(ValueError, match="does not change sign"):
        axis_curve(mesh, torch.ones(642, dtype=torch.float64))
    with pytest.raises(ValueError, match="n=2"):
        axis_curve(mesh, mesh.verts[:, 0], 2)


@given(shift=st.integers(0, 39), forward=st.booleans())
def test_a_shifted_or_reversed_copy_is_found_exactly(shift, forward):
    x = noise(40, 3).cumsum(0)
    y = (x if forward else x.flip(0)).roll(shift, 0)
    best, other = align_closed(x, y)
    assert best.forward == forward
    assert best.cost < 1e-6 < other.cost
    torch.testing.assert_close(y[best.partners], x, atol=1e-9, rtol=0)


def test_a_stretched_copy_is_followed():
    """Half of the curve runs at two thirds of the speed; features are smooth, and ambiguous without order."""
    n = 90
    s = torch.arange(n, dtype=torch.float64) / n
    warped = s + 0.08 * torch.sin(2 * math.pi * s)

    def feature(t):
        return torch.stack([torch.sin(4 * math.pi * t) + torch.cos(2 * math.pi * t), torch.sin(6 * math.pi * t)], 1)

    best = align_closed(feature(warped), feature(s))[0]
    gap = torch.remainder(best.partners / n - warped + 0.5, 1) - 0.5
    assert best.forward
    assert float(gap.abs().max()) < 0.03
    assert float((best.partners / n - s).abs().max()) > 0.05  # the identity is not the answer
    jumps = torch.remainder(best.partners.roll(-1) - best.partners, n)
    assert int(jumps.sum()) == n  # once around, never back
    assert int(jumps.max()) <= 2


def test_unequal_numbers_of_points():
    x = noise(30, 2).cumsum(0)
    best = align_closed(x, x.repeat_interleave(2, 0)[:50])[0]
    assert best.forward
    for a, b in ((2, 5), (5, 2), (10, 21)):
        with pytest.raises(ValueError, match=f"{a} and {b} points"):
            align_closed(noise(a, 2), noise(b, 2))


def test_a_mesh_in_two_pieces_has_two_axes():
    sphere = icosphere(2)
    both = Mesh(torch.cat([0.5 * sphere.verts + 5, sphere.verts]), torch.cat([sphere.faces, sphere.faces + 162]), "two")
    side = torch.cat([sphere.verts[:, 0], sphere.verts[:, 0]])
    curve = axis_curve(both, side, 20)
    assert curve.share == pytest.approx(2 / 3, rel=1e-6)
    assert int(curve.vertices.min()) >= 162
