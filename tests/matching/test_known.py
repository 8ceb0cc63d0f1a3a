import pytest
import torch
from references.pairs import FAST, exact_pair, side_of
from references.unchecked import unchecked

from torchqm.data.synthetic import creature
from torchqm.matching import extrinsic_symmetry, given_symmetry, no_symmetry, prepare, transferred_symmetry


@pytest.fixture(scope="module")
def known(exact):
    return extrinsic_symmetry(exact.x)


@pytest.fixture(scope="module")
def lopsided():
    """A creature without symmetry."""
    return prepare(creature("asymmetric", 600).mesh, 10)


def test_no_symmetry(exact):
    known = no_symmetry(exact.x, ["why"])
    assert torch.equal(known.group.maps, torch.arange(642)[None])
    assert torch.equal(known.sign, torch.zeros(642, dtype=torch.float64))
    assert (known.known, known.origin, known.warnings) == (False, "none", ["why"])
    assert not no_symmetry(exact.x).firm


def test_mirror_plane(exact, known):
    assert torch.equal(known.group.maps, exact.group_x.maps)
    assert (known.known, known.firm, known.origin, known.warnings) == (True, True, "extrinsic", [])
    assert known.details["residual"] < 1e-6
    assert abs(known.details["normal"][0]) == pytest.approx(1)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_left_right_and_exactly_nothing_on_the_axis(exact, known, scale):
    """The side of a vertex on the axis is rounding; its sign would change with the units of the file."""
    mesh = exact.x.mesh
    found = extrinsic_symmetry(prepare(mesh.moved(mesh.verts * scale + 0.1 * scale), 5))
    side = side_of(exact.x, exact.group_x)
    assert 20 < int((side == 0).sum()) < 60
    assert torch.equal(found.sign, side) or torch.equal(found.sign, -side)
    assert torch.equal(found.sign, known.sign)


def test_a_lopsided_shape_has_the_trivial_group(lopsided):
    known = extrinsic_symmetry(lopsided)
    assert known.group.order == 1
    assert (known.known, known.origin) == (False, "none")
    assert torch.equal(known.sign, torch.zeros(lopsided.n_verts, dtype=torch.float64))
    (text,) = known.warnings
    assert text.startswith(f"{lopsided.mesh.label}: no mirror plane")
    assert f"rms {known.details['residual']:.4f}" in text
    assert known.details["residual"] > 0.03


def test_a_rough_plane_is_used_and_told(lopsided):
    known = extrinsic_symmetry(lopsided, max_residual=1.0)
    assert (known.known, known.firm) == (True, False)
    assert known.group.order == 2
    assert "fits only roughly" in known.warnings[0]
    assert f"rms {known.details['residual']:.4f}" in known.warnings[0]


def test_several_planes_are_one_group():
    body = creature("ellipsoid", 1000)
    found = extrinsic_symmetry(prepare(body.mesh, 60))
    assert (found.name, found.firm, found.reflection) == ("C2 x C2 x C2", True, False)
    assert found.details["planes"] == 3
    rows = [(body.base_group == row).all(1).nonzero().flatten().tolist() for row in found.group.maps]
    assert sorted(index for (index,) in rows) == list(range(8))  # each element of the true group once
    for (index,), turned in zip(rows, found.orientation, strict=True):
        assert float(turned) == float(body.orientation[index])
    for g, h in [(1, 2), (3, 4), (7, 1)]:
        assert torch.equal(found.group.maps[found.products[g, h]], found.group.maps[g][found.group.maps[h]])
    assert torch.equal(found.sign, torch.zeros_like(found.sign))


def test_a_subset_of_a_group_has_left_and_right_of_its_own():
    shape = prepare(creature("ellipsoid", 1000).mesh, 60)
    known = extrinsic_symmetry(shape)
    one = known.subset([0, 1], shape, {"why": "test"})
    assert (one.name, one.reflection, one.details["why"]) == ("C2", True, "test")
    plain = given_symmetry(shape, known.group.maps[:2])
    assert torch.equal(one.sign, plain.sign)
    assert float((one.sign * one.sign[one.group.maps[1]]).sum()) < -0.8 * shape.n_verts
    turn = int((known.orientation > 0).nonzero()[1])
    assert not known.subset([0, turn], shape, {}).reflection
    assert known.subset(range(8), shape, {"why": "all"}).details["why"] == "all"


def test_a_given_group():
    body = creature("ellipsoid", 1000)
    shape = prepare(body.mesh, 60)
    known = given_symmetry(shape, body.base_group)
    assert (known.name, known.origin, known.warnings) == ("C2 x C2 x C2", "file", [])
    assert known.details["closure"] == 0
    assert torch.equal(known.orientation, body.orientation.double())
    with pytest.raises(ValueError, match="the 3 maps of the symmetry are no group"):
        given_symmetry(shape, body.base_group[[0, 1, 2]])


def test_a_given_symmetry_has_the_halves_of_its_axis():
    """The same reflection, found as a plane and handed in as a table: the same left and right but on the axis."""
    body = creature("quadruped", 1500)
    shape = prepare(body.mesh, 60)
    plane = extrinsic_symmetry(shape)
    given = given_symmetry(shape, plane.group.maps)
    agreement = float((plane.sign * given.sign * shape.mesh.vertex_areas).sum().abs())
    assert agreement > 0.93
    assert given.warnings == []


def test_a_half_turn_is_a_group_and_swaps_are_no_reflections():
    body = creature("ellipsoid", 1000)
    shape = prepare(body.mesh, 20)
    verts = body.mesh.verts
    turn = next(g for g in body.base_group if sum(bool((verts[:, a] * verts[g, a]).sum() < 0) for a in range(3)) == 2)
    known = given_symmetry(shape, torch.stack([torch.arange(shape.n_verts), turn]))
    assert known.name == "C2"
    assert known.orientation.tolist() == [1.0, 1.0]
    assert not known.reflection
    assert float(known.sign.abs().max()) == 0
    swap = torch.arange(shape.n_verts)
    swap[[3, 9]] = torch.tensor([9, 3])
    with pytest.raises(ValueError, match=r"it moves only 0\.\d% of the area"):
        given_symmetry(shape, torch.stack([torch.arange(shape.n_verts), swap]))


class TestGiven:
    def test_halves_are_found(self, exact):
        known = given_symmetry(exact.x, exact.group_x.maps)
        assert torch.equal(known.group.maps, exact.group_x.maps)
        assert (known.known, known.origin, known.warnings) == (True, "file", [])
        assert known.details["involution_error"] == 0
        side = exact.side_x
        assert float((known.sign * side)[side != 0].mean().abs()) > 0.97

    def test_the_identity_alone(self, exact):
        known = given_symmetry(exact.x, torch.arange(642)[None], "none")
        assert (known.known, known.origin) == (False, "none")
        assert torch.equal(known.sign, torch.zeros(642, dtype=torch.float64))

    def test_nearly_an_involution(self, exact):
        """Vertex maps of real symmetries do not come back exactly."""
        maps = exact.group_x.maps.clone()
        neighbour = exact.x.mesh.edges[:, 1][torch.searchsorted(exact.x.mesh.edges[:, 0].contiguous(), 7)]
        maps[1, 7] = maps[1, neighbour]
        known = given_symmetry(exact.x, maps)
        assert 0 < known.details["involution_error"] < 0.001

    @pytest.mark.parametrize(
        ("spoil", "message"),
        [
            (lambda maps: maps[:, :600], "600 entries a row, but blob2 has 642 vertices"),
            (lambda maps: maps.flip(0), "row 0 must be the identity"),
            (lambda maps: maps + torch.tensor([[0], [1]]), r"ids must lie in 0\.\.641"),
            (
                lambda maps: torch.stack([maps[0], maps[0].roll(160)]),
                "row 1 of the symmetry is no reflection: .* 0.1 is",
            ),
            (lambda maps: exact_pair(8).group_x.maps[:3], "blob2: the 3 maps of the symmetry are no group"),
        ],
        ids=["length", "identity", "ids", "involution", "order"],
    )
    def test_refusals(self, exact, spoil, message):
        with pytest.raises(ValueError, match=message):
            unchecked(given_symmetry)(exact.x, spoil(exact.group_x.maps))


@pytest.mark.parametrize("way", ["full_map", "clustering"])
def test_transferred(exact, known, way):
    found = transferred_symmetry(exact.y, exact.x, known, FAST, way)
    assert float((found.group.maps[1] == exact.group_y.maps[1]).double().mean()) > 0.99
    assert (found.known, found.origin, found.warnings) == (True, "transfer", [])
    assert found.details["reference"] == "blob2"
    assert found.details["way"] == way
    numbers = {"full_map": {"residual_direct", "residual_mirrored"}, "clustering": {"persistence", "margin", "balance"}}
    assert set(found.details) == {"reference", "way", "self_map_scores"} | numbers[way]
