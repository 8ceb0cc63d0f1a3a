"""torchqm.fmap.convert: deltas, point maps from functional maps and back, for exact isometries."""

import pytest
import torch
from references.shapes import basis_of, renumbered
from references.unchecked import unchecked

import torchqm.fmap.convert as convert
from torchqm.fmap import deltas, fmap_to_p2p, nearest_used, p2p_to_fmap
from torchqm.fmap.threads import one_thread
from torchqm.geometry import Mesh
from torchqm.spectral import mesh_basis
from torchqm.symmetry import symmetrized_basis
from torchqm.testing import assert_orbit_equal


@pytest.fixture(scope="module")
def pair(mirror_blob):
    return basis_of(mirror_blob.mesh, 30), renumbered(mirror_blob, 30)


def test_deltas_are_heat_from_a_point(pair):
    basis, _ = pair
    assert deltas(basis) is basis.evecs
    point = torch.zeros(642, 1, dtype=torch.float64)
    point[17] = 1 / basis.mass[17]  # unit mass at a vertex
    for time in (0.0, 0.05):
        torch.testing.assert_close(basis.evecs @ deltas(basis, time)[17, :, None], basis.low_pass(point, time))
    with pytest.raises(ValueError, match=r"time=-0\.1"):
        deltas(basis, -0.1)


def test_even_deltas_are_symmetrised_ones(mirror_blob):
    basis = basis_of(mirror_blob.mesh, 30)
    even = symmetrized_basis(basis, mirror_blob.group).even
    mirror = mirror_blob.group.maps[1]
    full = basis.evecs @ deltas(basis, 0.02).T  # column x: delta of x
    torch.testing.assert_close(even.evecs @ deltas(even, 0.02).T, (full + full[:, mirror]) / 2, atol=1e-7, rtol=0)


@pytest.mark.parametrize("time", [0.0, 0.01])
def test_exact_isometry_goes_both_ways(pair, time):
    x, copy = pair
    fmap_xy = p2p_to_fmap(copy.p2p_yx, x, copy.basis)
    assert torch.equal(fmap_to_p2p(fmap_xy, x, copy.basis, time), copy.p2p_xy)
    assert torch.equal(fmap_to_p2p(fmap_xy.T, copy.basis, x, time), copy.p2p_yx)


def test_directions(pair):
    """A map from functions on x to functions on y carries a function along."""
    x, copy = pair
    fmap_xy = p2p_to_fmap(copy.p2p_yx, x, copy.basis)
    on_x = x.evecs @ torch.linspace(-1, 1, 30, dtype=torch.float64)[:, None]
    torch.testing.assert_close(copy.basis.evecs @ fmap_xy @ x.coefficients(on_x), on_x[copy.p2p_yx])


def test_rectangular_maps(pair):
    x, copy = pair
    small = p2p_to_fmap(copy.p2p_yx, x.truncate(12), copy.basis)
    assert small.shape == (30, 12)
    torch.testing.assert_close(small, p2p_to_fmap(copy.p2p_yx, x, copy.basis)[:, :12])
    assert torch.equal(fmap_to_p2p(small.T, copy.basis, x.truncate(12)), copy.p2p_yx)


def test_even_block_gives_point_to_orbit_map(mirror_blob, pair):
    full, copy = pair
    x = symmetrized_basis(full, mirror_blob.group).even
    y = symmetrized_basis(copy.basis, copy.shape.group).even
    found = fmap_to_p2p(p2p_to_fmap(copy.p2p_yx, x, y), x, y)
    assert_orbit_equal(found, copy.p2p_xy, copy.shape.group.orbits)


def test_vertices_without_area_are_no_images(mirror_blob):
    mesh = mirror_blob.mesh
    stray = Mesh(torch.cat([torch.zeros(3, 3, dtype=torch.float64), mesh.verts]), mesh.faces + 3)
    basis = mesh_basis(stray, 12)
    zero = torch.zeros(5, 12, dtype=torch.float64)  # the coefficients of the stray vertices
    assert int(nearest_used(zero, basis).min()) >= 3
    itself = fmap_to_p2p(torch.eye(12, dtype=torch.float64), basis, basis)
    assert torch.equal(itself[3:], torch.arange(3, 645))
    assert int(itself.min()) >= 3


def test_wrong_length(pair):
    x, copy = pair
    with pytest.raises(ValueError, match="p2p_yx has 7 entries, but y has 642 vertices"):
        unchecked(p2p_to_fmap)(copy.p2p_yx[:7], x, copy.basis)


@pytest.mark.parametrize("threads", [1, 3])
def test_blocks_of_vertices_give_the_pull_back(pair, threads, monkeypatch):
    """By blocks of 100 of the 642 vertices, the same to the last bit on any number of threads."""
    x, other = pair
    y, p2p = other.basis, other.p2p_yx
    wanted = y.coefficients(x.evecs[p2p])
    monkeypatch.setattr(convert, "_ROWS", 100)
    alone, before = p2p_to_fmap(p2p, x, y), torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with one_thread():
            found = p2p_to_fmap(p2p, x, y)
    finally:
        torch.set_num_threads(before)
    torch.testing.assert_close(found, wanted, atol=1e-13, rtol=0)
    assert torch.equal(found, alone)
