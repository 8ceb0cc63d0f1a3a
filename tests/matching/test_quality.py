import pytest
import torch
from references.shapes import basis_of, blob, renumbered

from torchqm.geometry import Mesh
from torchqm.matching.quality import commutativity_score, orientation_agreement, torn_length


@pytest.fixture(scope="module")
def shape():
    return blob(2)


def test_isometries_score_zero(shape, either):
    for target in (either.p2p_xy, either.group_y.maps[1][either.p2p_xy]):
        assert commutativity_score(target, either.x.basis, either.y.basis) < 1e-8


def test_the_score_is_the_formula_and_grows_with_the_damage(shape):
    copy = renumbered(shape, 30)
    basis = basis_of(shape.mesh, 30)
    damaged = copy.p2p_xy.clone()
    scores = []
    for step in (1000, 20, 4):
        damaged[::step] = damaged[::step].flip(0)
        scores.append(commutativity_score(damaged, basis, copy.basis, 20))
    assert scores == sorted(scores)
    assert scores[-1] > 10 * scores[0]
    fmap = basis.evecs_trans[:20] @ copy.basis.evecs[damaged, :20]
    right, left = fmap @ torch.diag(copy.basis.evals[:20]), torch.diag(basis.evals[:20]) @ fmap
    assert scores[-1] == pytest.approx(float((right - left).norm() / (right.norm() + left.norm())))


def test_few_functions_are_enough(shape):
    small = basis_of(shape.mesh, 8)
    assert commutativity_score(torch.arange(642), small, basis_of(shape.mesh, 30)) == pytest.approx(0, abs=1e-9)
    assert commutativity_score(torch.zeros(642, dtype=torch.int64), small, small) <= 1


def test_orientation_of_exact_maps(either):
    keeps = 1.0 if torch.allclose(either.x.mesh.verts, either.y.mesh.verts[either.p2p_xy]) else -1.0
    x, y = either.x.mesh, either.y.mesh
    assert orientation_agreement(x, y, either.p2p_xy) == pytest.approx(keeps)
    assert orientation_agreement(x, y, either.group_y.maps[1][either.p2p_xy]) == pytest.approx(-keeps)


def test_it_is_weighted_by_area(shape):
    """Two blobs of areas 1 and 4: the first mapped by the identity, the second by its reflection."""
    mesh, reflection = shape.mesh, shape.group.maps[1]
    both = Mesh(torch.cat([mesh.verts, 2 * mesh.verts + 9]), torch.cat([mesh.faces, mesh.faces + 642]))
    straight = torch.arange(1284)
    half = torch.cat([straight[:642], reflection + 642])
    assert orientation_agreement(both, both, straight) == pytest.approx(1)
    assert orientation_agreement(both, both, half) == pytest.approx((1 - 4) / 5)
    collapsed = torch.cat([straight[:642], torch.full((642,), 642)])  # triangles without image say nothing
    assert orientation_agreement(both, both, collapsed) == pytest.approx(1)


def test_a_constant_map_has_no_orientation(shape):
    assert orientation_agreement(shape.mesh, shape.mesh, torch.zeros(642, dtype=torch.int64)) == 0


class TestTornLength:
    def test_symmetries_tear_nothing(self, octopus, biped):
        for exact in (octopus, biped):
            assert {torn_length(exact.shape.mesh, element) for element in exact.group} == {0.0}

    def test_a_strip_cut_in_two(self):
        """A square of 20 x 20 cells; the right half is moved to where the left one is: one column of edges is torn."""
        n = 21
        y, x = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
        verts = torch.stack([x.flatten(), y.flatten(), torch.zeros(n * n)], 1).double() / (n - 1)
        corner = (torch.arange(n - 1)[:, None] * n + torch.arange(n - 1)).flatten()
        faces = torch.cat(
            [torch.stack([corner, corner + 1, corner + n], 1), torch.stack([corner + 1, corner + n + 1, corner + n], 1)]
        )
        mesh = Mesh.from_arrays(verts.numpy(), faces.numpy())
        moved = torch.arange(n * n) - torch.where(x.flatten() > 10, 10, 0)
        # Across the cut go 21 edges of 1/20 and, on the 20 diagonals, as many of sqrt(2)/20.
        assert torn_length(mesh, moved) == pytest.approx(21 / 20 + 2**0.5)
        assert torn_length(mesh, torch.arange(n * n)) == 0

    @pytest.mark.parametrize("axis", [1, 2])
    def test_half_a_reflection_against_a_plain_loop(self, biped, axis):
        mesh, mirror = biped.shape.mesh, biped.group[1]
        side = mesh.verts[:, axis] > float(mesh.verts[:, axis].median())
        p2p = torch.where(side, mirror, torch.arange(mesh.n_verts))
        total = 0.0
        for a, b in mesh.edges.tolist():
            length = float((mesh.verts[a] - mesh.verts[b]).norm())
            image = float((mesh.verts[p2p[a]] - mesh.verts[p2p[b]]).norm())
            total += length if image > 3 * length + 0.02 else 0.0
        assert torn_length(mesh, p2p) == pytest.approx(total)
        assert total > 0.5
