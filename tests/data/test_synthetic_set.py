import pytest
import torch

from torchqm.data.base import LayoutError, TruthError
from torchqm.data.synthetic import creature
from torchqm.data.synthetic_set import SyntheticOptions, SyntheticShapes
from torchqm.evaluate.metrics import SurfacePoints
from torchqm.geometry import MeshError, check_mesh


@pytest.fixture(scope="module")
def own():
    return SyntheticShapes("synthetic:kinds=quadruped;poses=2;verts=600")


@pytest.fixture(scope="module")
def shared():
    return SyntheticShapes("synthetic:kinds=quadruped,ellipsoid;poses=2;verts=600;triangulation=shared")


def test_the_plain_root_has_a_rest_pose_of_each_body_and_posed_ones():
    shapes = SyntheticShapes("synthetic:")
    assert shapes.options == SyntheticOptions()
    assert shapes.names == [f"{kind}-0-pose{p}" for kind in ("biped", "quadruped") for p in range(3)]
    assert shapes.classes == ["biped-0", "quadruped-0"]
    assert [shapes.shape_class(name) for name in shapes.names] == ["biped-0"] * 3 + ["quadruped-0"] * 3
    assert shapes.layout == "synthetic"
    assert shapes.path("biped-0-pose1") is None
    assert shapes.problems() == []
    assert shapes.published_pairs() == []


def test_seeds_draw_other_bodies_and_poses_but_keep_a_rest_pose():
    names = SyntheticShapes("synthetic:kinds=biped;bodies=2;poses=2;seed=3;").names
    assert names == ["biped-300-pose0", "biped-300-pose301", "biped-301-pose0", "biped-301-pose301"]
    assert not set(names) & set(SyntheticShapes("synthetic:kinds=biped;bodies=100;poses=100;seed=2").names)


def test_meshes_are_the_creatures_that_the_names_say_and_are_kept(own, shared):
    mesh = shared.mesh("quadruped-0-pose1")
    made = creature("quadruped", 600, 0, 1).mesh
    assert torch.equal(mesh.verts, made.verts)
    assert torch.equal(mesh.faces, made.faces)
    assert mesh.name == "quadruped-0-pose1"
    assert shared.mesh("quadruped-0-pose1") is mesh
    assert check_mesh(own.mesh("quadruped-0-pose1")).closed
    first, second = (own.mesh(f"quadruped-0-pose{p}") for p in (0, 1))
    assert first.n_verts != second.n_verts or not torch.equal(first.faces, second.faces)


def test_shared_triangles_have_vertex_ids_for_truth(shared):
    truth = shared.truth("quadruped-0-pose0", "quadruped-0-pose1")
    assert torch.equal(truth.at, truth.points)
    assert torch.equal(truth.points, shared.exact("quadruped-0-pose0", "quadruped-0-pose1").nearest_vertices()[0])
    assert len(truth) == shared.mesh("quadruped-0-pose0").n_verts
    assert "vertex ids" in truth.source


def test_own_triangles_have_points_in_faces_that_lie_on_the_same_place_at_rest(own):
    """At rest both triangulations are of one body: the true point lies where the vertex lies."""
    first, second = "quadruped-0-pose0", "quadruped-0-pose1"
    truth = own.truth(first, second)
    assert isinstance(truth.points, SurfacePoints)
    rest = own.creature(second).rest
    points = (rest.verts[truth.points.corners] * truth.points.bary[..., None]).sum(1)
    gap = (points - own.creature(first).rest.verts).norm(dim=1) / rest.area**0.5
    assert float(gap.max()) < 0.02  # triangles this large cut that far into the surface
    assert set(map(tuple, truth.points.corners.sort(1).values.tolist())) <= set(
        map(tuple, own.mesh(second).faces.sort(1).values.tolist())
    )
    assert torch.equal(own.truth(first, first).points, own.exact(first, first).nearest_vertices()[0])


def test_symmetry_is_the_whole_group_of_the_shape(shared):
    group = shared.symmetry("ellipsoid-0-pose0")
    assert group.order == 8
    assert shared.symmetry("ellipsoid-0-pose0") is group
    residuals = group.residuals(shared.mesh("ellipsoid-0-pose0").verts)
    assert residuals.name == "C2 x C2 x C2"
    assert residuals.closure == 0
    assert shared.symmetry_truth("ellipsoid-0-pose0") is None  # which of the seven?
    assert shared.mirrored_truth("ellipsoid-0-pose0", "ellipsoid-0-pose1") is None


def test_the_reflection_of_a_rest_pose_mirrors_it_in_space(own):
    name = "quadruped-0-pose0"
    truth, verts = own.symmetry_truth(name), own.mesh(name).verts
    images = (verts[truth.points.corners] * truth.points.bary[..., None]).sum(1)
    mirrored = verts * torch.tensor([-1.0, 1.0, 1.0])
    assert float((images - mirrored).norm(dim=1).max()) < 0.02
    assert torch.equal(truth.vertices, own.symmetry(name).maps[1])
    assert "reflection" in truth.source


def test_the_mirrored_truth_is_the_truth_and_then_the_reflection(own):
    first, second = "quadruped-0-pose1", "quadruped-0-pose0"
    direct, mirrored = own.truth(first, second), own.mirrored_truth(first, second)
    verts = own.mesh(second).verts

    def place(truth):
        return (verts[truth.points.corners] * truth.points.bary[..., None]).sum(1)

    expected = place(direct) * torch.tensor([-1.0, 1.0, 1.0])
    assert float((place(mirrored) - expected).norm(dim=1).max()) < 0.02


def test_what_a_body_offers_is_said_in_a_few_words(own, shared):
    assert own.about("quadruped-0") == ("exact points in faces", "exact group of 2")
    assert shared.about("ellipsoid-0") == ("same vertex ids", "exact group of 8")


def test_the_same_root_gives_the_same_shapes():
    root = "synthetic:kinds=quadruped;poses=2;verts=600"
    a, b = SyntheticShapes(root), SyntheticShapes(root)
    for name in a.names:
        assert a.mesh(name) is not b.mesh(name)
        assert torch.equal(a.mesh(name).verts, b.mesh(name).verts)
        assert torch.equal(a.mesh(name).faces, b.mesh(name).faces)


def test_bodies_have_no_truth_between_them(shared):
    with pytest.raises(TruthError, match="no truth from quadruped-0-pose0 to ellipsoid-0-pose0: bodies"):
        shared.truth("quadruped-0-pose0", "ellipsoid-0-pose0")
    with pytest.raises(ValueError, match="no shape 'dog'"):
        shared.mesh("dog")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("legs=3", r"unknown key 'legs'; allowed are kinds, bodies, poses, verts, seed, triangulation"),
        ("poses", "'poses' is no 'key=value'"),
        ("poses=2;poses=3", "'poses' is given twice"),
        ("poses=0", "poses is '0'; allowed are whole numbers from 1 to 100"),
        ("poses=²", "poses is '²'"),
        ("verts=10", "verts is '10'; allowed are whole numbers from 500 to 400000"),
        ("seed=-1", "seed is '-1'"),
        ("kinds=dog,biped", "unknown 'dog'; allowed are biped"),
        ("kinds=", "at least one"),
        ("kinds=biped,biped", "each once"),
        ("triangulation=mine", "triangulation is 'mine'; allowed are own and shared"),
    ],
)
def test_a_wrong_root_says_what_is_wrong(options, message):
    with pytest.raises(LayoutError, match=message) as caught:
        SyntheticShapes(f"synthetic:{options}")
    assert str(caught.value).startswith(f"synthetic:{options}: ")


def test_a_creature_that_cannot_be_made_is_a_fault_of_its_mesh(monkeypatch):
    def fails(*arguments):
        raise RuntimeError("it could not be retriangulated")

    monkeypatch.setattr("torchqm.data.synthetic_set.creature", fails)
    with pytest.raises(MeshError, match=r"synthetic:verts=500: biped-0-pose1: it could not be .*; try more verts"):
        SyntheticShapes("synthetic:verts=500").mesh("biped-0-pose1")


def test_another_root_is_refused():
    with pytest.raises(LayoutError, match="starts with 'synthetic:'"):
        SyntheticShapes("/data/tosca")
