"""Measures without a truth, on maps where each has a value that can be written down."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references import shapes

from torchqm.evaluate import TruthDistances
from torchqm.evaluate.label_free import (
    LabelFree,
    bijectivity,
    commutativity,
    coverage,
    dirichlet_energy,
    label_free,
    orthogonality,
)
from torchqm.geometry.mesh import Mesh

FLAT = shapes.grid(4, 3, 2.0, 1.5)  # area 3, 20 vertices, spacing 0.5, vertex 4 i + j
EVERY = torch.arange(20)


def moved(mesh: Mesh, matrix: object) -> Mesh:
    return mesh.moved(mesh.verts @ torch.as_tensor(matrix, dtype=torch.float64).T)


# Bijectivity


def test_maps_that_undo_each_other_are_bijective(mirror_blob) -> None:
    forth = torch.randperm(642, generator=torch.Generator().manual_seed(1))
    assert bijectivity(mirror_blob.mesh, forth, forth.argsort(), method="dijkstra") == 0.0
    mirror = mirror_blob.group.maps[1]
    assert bijectivity(mirror_blob.mesh, mirror, mirror) == 0.0  # a mirrored map is as good as a direct one here


def test_bijectivity_is_the_area_weighted_way_back() -> None:
    back = EVERY.clone()
    back[5] = 6  # an inner vertex comes back at its neighbour, 0.5 away; it has area 0.25 of 3
    expected = 0.5 / 3**0.5 * 0.25 / 3
    assert bijectivity(FLAT, EVERY, back, method="dijkstra") == pytest.approx(expected)
    assert bijectivity(FLAT, EVERY, back, at=torch.tensor([5, 0]), method="dijkstra") == pytest.approx(0.5 / 3**0.5 / 2)


def test_few_into_many_can_be_undone_and_many_into_few_cannot() -> None:
    """Every second column of the grid is a shape of its own."""
    few = shapes.grid(2, 3, 2.0, 1.5)
    into = torch.cat([torch.arange(4) + 8 * i for i in range(3)])  # (12,) vertices of FLAT
    home = torch.cat([torch.arange(4) + 4 * (i // 2) for i in range(5)])  # each column to one that is there
    assert bijectivity(few, into, home, method="dijkstra") == 0.0
    lost = bijectivity(FLAT, home, into, method="dijkstra")
    assert lost == pytest.approx(0.5 / 3**0.5 * 2 / 4)  # two inner columns of four column widths are 0.5 off


def test_bijectivity_ignores_vertices_of_no_face_and_takes_rows_at_hand() -> None:
    loose = Mesh(torch.cat([FLAT.verts, torch.full((1, 3), 9.0, dtype=torch.float64)]), FLAT.faces, "loose")
    home = torch.cat([EVERY, torch.tensor([0])])
    assert bijectivity(loose, home, EVERY) == 0.0
    at = torch.tensor([0, 19])
    rows = TruthDistances.build(FLAT, at, "exact")
    turned = bijectivity(FLAT, EVERY, EVERY.flip(0), at, distances=rows)
    assert turned == pytest.approx(math.hypot(2, 1.5) / 3**0.5)


# Coverage


def test_coverage_is_the_area_share_of_the_vertices_reached() -> None:
    assert coverage(FLAT, EVERY.roll(7)) == pytest.approx(1.0)
    assert coverage(FLAT, torch.full((5,), 5)) == pytest.approx(0.25 / 3)
    assert coverage(FLAT, torch.arange(4, 20)) == pytest.approx(1 - 0.5 / 4)  # without the first column
    one = Mesh.from_arrays([[0, 0, 0], [3, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    assert coverage(one, torch.tensor([0, 0, 1])) == pytest.approx(2 / 3)


@given(st.lists(st.integers(0, 19), min_size=1, max_size=30), st.randoms())
def test_coverage_grows_with_the_image_and_does_not_see_order(images: list[int], random) -> None:
    whole = coverage(FLAT, torch.tensor(images))
    assert coverage(FLAT, torch.tensor(images[: (len(images) + 1) // 2])) <= whole + 1e-12
    assert coverage(FLAT, torch.tensor(random.sample(images, len(images)) + images)) == pytest.approx(whole)


# Dirichlet energy


def test_dirichlet_energy_of_isometries_is_one(blob) -> None:
    every = torch.arange(642)
    turned = moved(blob.mesh, 3.7 * shapes.rotation(2).numpy())
    for y in (blob.mesh, turned, moved(blob.mesh, np.diag([1, -1, 1]))):
        assert dirichlet_energy(blob.mesh, y, every) == pytest.approx(1.0, abs=1e-12)
    for row in blob.group.maps:
        assert dirichlet_energy(blob.mesh, blob.mesh, row) == pytest.approx(1.0, abs=1e-9)


@given(
    st.lists(st.floats(-3, 3), min_size=4, max_size=4).filter(lambda m: abs(m[0] * m[3] - m[1] * m[2]) > 0.05),
)
def test_dirichlet_energy_of_a_linear_map_is_its_norm_over_its_determinant(entries: list[float]) -> None:
    a, b, c, d = entries
    y = moved(FLAT, [[a, b, 0], [c, d, 0], [0, 0, 1]])
    energy = dirichlet_energy(FLAT, y, EVERY)
    assert energy == pytest.approx((a * a + b * b + c * c + d * d) / 2 / abs(a * d - b * c), rel=1e-9)
    assert energy >= 1 - 1e-9  # the area of the image is all of y


def test_dirichlet_energy_of_collapsed_and_torn_maps() -> None:
    assert dirichlet_energy(FLAT, FLAT, torch.full((20,), 7)) == 0.0
    torn = torch.where(EVERY < 12, EVERY, torch.zeros_like(EVERY))  # the last two columns go to the corner
    # 1.5 for the columns that stay; squared slopes of x (24) and y (22) in six stretched triangles of area 1/8
    assert dirichlet_energy(FLAT, FLAT, torn) == pytest.approx((1.5 + 46 / 8 / 2) / 3)


def test_scales_of_both_shapes_do_not_matter() -> None:
    p2p = EVERY.flip(0).roll(1)
    small, large = moved(FLAT, 1e-6 * np.eye(3)), moved(FLAT, 1e6 * np.eye(3))
    expected = dirichlet_energy(FLAT, FLAT, p2p)
    assert dirichlet_energy(small, large, p2p) == pytest.approx(expected, rel=1e-9)
    assert coverage(large, p2p) == pytest.approx(coverage(FLAT, p2p))
    assert bijectivity(small, EVERY, p2p) == pytest.approx(bijectivity(large, EVERY, p2p), rel=1e-5)


# Functional maps


def test_orthogonality_of_matrices_whose_gram_matrix_is_known() -> None:
    assert orthogonality(shapes.rotation(3)) == pytest.approx(0.0, abs=1e-24)
    assert orthogonality(2 * torch.eye(5)) == 9.0
    assert orthogonality(torch.zeros(4, 4)) == 1.0
    assert orthogonality(torch.eye(4, 2)) == orthogonality(torch.eye(2, 4)) == 0.0  # of the smaller side
    assert orthogonality(2 * torch.eye(4, 2)) == orthogonality(2 * torch.eye(2, 4)) == 9.0


def test_commutativity_of_matrices_that_do_and_do_not_commute() -> None:
    evals = torch.tensor([0.0, 1.0, 4.0])
    assert commutativity(torch.diag(torch.tensor([1.0, -3.0, 0.5])), evals, evals) == 0.0
    swap = torch.eye(3)[[0, 2, 1]]
    # C D - D C has +-3 twice; C D and D C have 1 and 4
    assert commutativity(swap, evals, evals) == pytest.approx(math.sqrt(18) / (2 * math.sqrt(17)))
    assert commutativity(swap, evals, evals[[0, 2, 1]]) == 0.0


@given(st.integers(0, 1000), st.integers(1, 6), st.integers(1, 6))
def test_commutativity_is_a_share_without_a_unit(seed: int, kx: int, ky: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    fmap = torch.randn(ky, kx, generator=generator, dtype=torch.float64)
    x, y = (torch.rand(k, generator=generator, dtype=torch.float64).sort().values for k in (kx, ky))
    value = commutativity(fmap, x, y)
    assert 0 <= value <= 1 + 1e-12
    assert commutativity(5 * fmap, 100 * x, 100 * y) == pytest.approx(value)


# All of them


def test_an_exact_isometry_has_the_best_of_everything_and_so_has_the_mirrored_one(mirror_blob) -> None:
    copy = shapes.renumbered(mirror_blob, 20)
    basis = shapes.basis_of(mirror_blob.mesh, 20)
    for element in mirror_blob.group.maps:
        forth, back = copy.p2p_xy[element], element.argsort()[copy.p2p_yx]
        found = label_free(mirror_blob.mesh, copy.shape.mesh, forth, back, basis, copy.basis)
        assert found.coverage == pytest.approx(1.0)
        assert found.dirichlet_energy == pytest.approx(1.0, abs=1e-9)
        assert found.bijectivity == 0.0
        assert found.orthogonality == pytest.approx(0.0, abs=1e-10)
        assert found.commutativity == pytest.approx(0.0, abs=1e-6)
        assert (found.k, found.solver) == (20, "fast_marching")


def test_what_was_not_given_is_none_and_the_row_is_flat() -> None:
    found = label_free(FLAT, FLAT, EVERY)
    assert found == LabelFree(found.coverage, found.dirichlet_energy)
    assert found.to_row() == {
        "coverage": pytest.approx(1.0),
        "dirichlet_energy": pytest.approx(1.0),
        "bijectivity": None,
        "orthogonality": None,
        "commutativity": None,
        "label_free_k": None,
        "label_free_solver": None,
    }


def test_a_noisy_map_is_worse_in_everything(mirror_blob) -> None:
    basis = shapes.basis_of(mirror_blob.mesh, 20)
    p2p = torch.randint(642, (642,), generator=torch.Generator().manual_seed(0))
    at = torch.arange(0, 642, 64)
    found = label_free(mirror_blob.mesh, mirror_blob.mesh, p2p, p2p, basis, basis, k=10, at=at, method="dijkstra")
    assert found.k == 10
    assert found.solver == "dijkstra"
    assert found.coverage < 0.75  # 1 - 1/e of equal vertices
    assert found.dirichlet_energy > 10
    assert found.bijectivity is not None
    assert found.bijectivity > 0.3
    assert found.orthogonality is not None
    assert found.orthogonality > 0.3
    assert found.commutativity is not None
    assert found.commutativity > 0.3


def test_what_does_not_fit_is_named() -> None:
    point = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], "flat")
    with pytest.raises(ValueError, match=r"p2p_xy: entries must lie in 0\.\.19, got 1\.\.20"):
        coverage(FLAT, EVERY + 1)
    with pytest.raises(ValueError, match="p2p_xy: expected an entry for each of the 20 vertices"):
        dirichlet_energy(FLAT, FLAT, EVERY[:3])
    with pytest.raises(ValueError, match="flat has area 0"):
        coverage(point, torch.tensor([0]))
    with pytest.raises(ValueError, match="flat has area 0"):
        dirichlet_energy(FLAT, point, torch.zeros(20, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"p2p_yx: entries must lie in 0\.\.19"):
        bijectivity(FLAT, EVERY, EVERY + 1)
    with pytest.raises(ValueError, match=r"p2p_xy: entries must lie in 0\.\.9"):
        bijectivity(FLAT, EVERY, EVERY[:10])
    with pytest.raises(ValueError, match=r"at: expected vertices in 0\.\.19, got 20\.\.20"):
        bijectivity(FLAT, EVERY, EVERY, torch.tensor([20]))
    with pytest.raises(ValueError, match=r"at: .* got none"):
        bijectivity(FLAT, EVERY, EVERY, EVERY[:0])
