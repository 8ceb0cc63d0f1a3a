"""torchqm.geometry.check: every count on a mesh where it is known, and what is refused."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from torchqm.geometry import Mesh, MeshError, check_mesh, clean_faces, inspect_mesh, orient_faces, weld

GRID = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
TWO = [[0, 1, 2], [1, 3, 2]]


def sphere(level=2):
    ball = trimesh.creation.icosphere(subdivisions=level)
    return Mesh.from_arrays(ball.vertices, ball.faces, name="ball")


def moebius(n=12):
    angle = np.arange(n) * 2 * np.pi / n
    half = 0.3 * np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], 1)
    centre = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    faces = []
    for i in range(n):
        a, b = 2 * i, 2 * i + 1
        c, d = (2 * i + 2, 2 * i + 3) if i < n - 1 else (1, 0)
        faces += [[a, c, b], [b, c, d]]
    return Mesh.from_arrays(np.stack([centre - half, centre + half], 1).reshape(-1, 3), faces)


def test_a_closed_sphere_has_nothing_to_report():
    mesh = sphere()
    report = check_mesh(mesh)
    assert report.warnings == []
    assert (report.euler, report.n_components, report.n_boundary_edges) == (2, 1, 0)
    assert report.closed
    assert report.manifold
    assert report.oriented
    assert report.area == pytest.approx(mesh.area)
    assert 50 < report.min_angle < report.median_min_angle < 60


def test_torus_euler_characteristic():
    torus = trimesh.creation.torus(1.0, 0.3, major_sections=12, minor_sections=8)
    assert inspect_mesh(Mesh.from_arrays(torus.vertices, torus.faces)).euler == 0


def test_open_square():
    report = check_mesh(Mesh.from_arrays(GRID, TWO))
    assert (report.n_boundary_edges, report.euler, report.min_angle) == (4, 1, pytest.approx(45))
    assert len(report.warnings) == 1
    assert "4 boundary edges" in report.warnings[0]
    assert "Neumann" in report.warnings[0]


def test_unreferenced_duplicate_degenerate_and_repeated_are_counted_and_reported():
    verts = [*GRID, [5, 5, 5], [1, 0, 0], [2, 0, 0]]
    faces = [*TWO, [2, 0, 1], [0, 0, 3], [1, 3, 6], [0, 1, 6]]  # repeated, repeated corner, sound, flat
    report = check_mesh(Mesh.from_arrays(verts, faces, name="odd"))
    assert (report.n_unreferenced, report.n_duplicate_verts) == (2, 1)
    assert (report.n_degenerate, report.n_flat, report.n_repeated) == (2, 1, 1)
    text = "\n".join(report.warnings)
    for part in (
        "odd: 2 of 7 vertices belong to no triangle",
        "1 vertices repeat the position",
        "2 of 6 triangles are degenerate: 1 with a repeated corner (dropped), 1 flat",
        "1 of 6 triangles repeat",
    ):
        assert part in text


def test_clean_faces_keeps_the_first_and_the_order():
    faces = [[2, 3, 1], [0, 1, 2], [1, 1, 0], [1, 2, 0], [2, 1, 3]]
    assert clean_faces(Mesh.from_arrays(GRID, faces)).tolist() == [[2, 3, 1], [0, 1, 2]]


@pytest.mark.parametrize("scale", [1e-180, 1e-50, 1e-12, 1.0, 1e12, 1e50, 1e150, 1e307])
def test_counts_do_not_depend_on_the_scale(scale):
    needle = [[0, 0, 0], [1, 0, 0], [0.5, 1e-6, 0], [0.5, 1, 0], [0.5, 1 + 1e-9, 0]]
    mesh = Mesh.from_arrays(np.array(needle) * scale, [[0, 1, 2], [0, 2, 3], [2, 1, 3], [0, 3, 4]])
    report = inspect_mesh(mesh)
    assert (report.n_flat, report.n_components, report.n_boundary_edges) == (1, 1, 4)
    assert report.min_angle == pytest.approx(inspect_mesh(mesh.moved(mesh.verts / scale)).min_angle, rel=1e-6)


@pytest.mark.parametrize("scale", [1e-60, 1e-50, 1e50, 1e60])
def test_areas_keep_their_digits_at_every_scale_that_is_let_through(scale):
    mesh = sphere(3)
    size = scale / float((mesh.verts.amax(0) - mesh.verts.amin(0)).max()) * (1 - 1e-9 if scale > 1 else 1 + 1e-9)
    scaled = mesh.moved(mesh.verts * size)
    report = check_mesh(scaled)
    assert report.warnings == []
    assert report.area / size / size == pytest.approx(mesh.area)
    assert scaled.area / size / size == pytest.approx(mesh.area)
    assert torch.allclose(scaled.vertex_areas / scaled.area, mesh.vertex_areas / mesh.area)


@pytest.mark.parametrize(
    ("scale", "fault"),
    [
        (5e-324, r"too small: their extent is 9\.88e-324"),
        (1e-100, r"too small: their extent is 2e-100"),
        (4e-61, r"too small: their extent is 8e-61"),
        (6e60, r"too large: their extent is 1\.2e\+61"),
        (1e100, r"too large: their extent is 2e\+100"),
        (1.7e308, r"too large: their extent is more than 1\.8e\+308"),
    ],
)
def test_other_extents_are_refused_with_the_extent_and_the_cure(scale, fault):
    verts = np.array([[-1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * scale
    mesh = Mesh.from_arrays(verts, [[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]], name="fly.off")
    with pytest.raises(MeshError, match=f"^fly.off: the coordinates are {fault}, allowed are 1e-60 to .*rescale"):
        check_mesh(mesh)


def test_a_stray_vertex_does_not_hide_a_small_surface_and_is_itself_held_to_the_limit():
    grid = np.array([*GRID, [5.0, 5, 5]])
    small, far = grid.copy(), grid.copy()
    small[:4] *= 1e-70
    far[4] *= 1e70
    with pytest.raises(MeshError, match=r"too small: their extent is 1e-70"):
        check_mesh(Mesh.from_arrays(small, TWO))
    with pytest.raises(MeshError, match=r"too large: their extent is 5e\+70"):
        check_mesh(Mesh.from_arrays(far, TWO))


def test_inspecting_never_overflows_without_a_word():
    verts = np.array([[-1.7e308, 0, 0], [1.7e308, 0, 0], [0, 1, 0]])
    with pytest.raises(MeshError, match="too large"):
        inspect_mesh(Mesh.from_arrays(verts, [[0, 1, 2]]))
    large = inspect_mesh(Mesh.from_arrays(np.array(GRID) * 1e307, TWO))
    assert (large.area, large.relative_area) == (np.inf, pytest.approx(1))
    assert inspect_mesh(Mesh.from_arrays(np.array(GRID) * 1e-307, TWO)).area == 0


def test_flat_means_height_relative_to_the_longest_edge():
    def flat(height):
        return inspect_mesh(Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0.5, height, 0]], [[0, 1, 2]])).n_flat

    assert flat(0) == flat(5e-9) == 1
    assert flat(2e-8) == flat(1e-3) == 0


def test_nonmanifold_edge():
    report = check_mesh(Mesh.from_arrays([*GRID, [0.5, 0.5, 1]], [*TWO, [1, 2, 4]]))
    assert (report.n_nonmanifold_edges, report.n_nonmanifold_verts, report.manifold) == (1, 0, False)
    assert "robust Laplacian" in "\n".join(report.warnings)


def test_nonmanifold_vertex():
    report = check_mesh(Mesh.from_arrays([*GRID, [-1, 0, 0], [0, -1, 0]], [*TWO, [0, 4, 5]]))
    assert (report.n_nonmanifold_edges, report.n_nonmanifold_verts, report.manifold) == (0, 1, False)
    assert report.n_components == 1


def test_sliver_share():
    verts = [[0, 0, 0], [1, 0, 0], [0.5, -0.001, 0], [0.5, 0.999, 0]]  # areas 0.0005 and 0.4995
    report = inspect_mesh(Mesh.from_arrays(verts, [[0, 2, 1], [0, 1, 3]]))
    assert report.sliver_share == pytest.approx(0.001)


def test_orientation_is_noticed_and_mended():
    mesh = sphere()
    flipped = mesh.faces.clone()
    flipped[::7] = flipped[::7][:, [0, 2, 1]]
    bad = Mesh(mesh.verts, flipped, "flipped")
    report = check_mesh(bad)
    assert not report.oriented
    assert "not consistently oriented" in report.warnings[0]
    assert torch.equal(orient_faces(bad), mesh.faces)
    assert torch.equal(orient_faces(mesh), mesh.faces)


def test_moebius_strip_has_no_orientation():
    report = check_mesh(moebius())
    assert (report.euler, report.manifold, report.oriented) == (0, True, False)
    assert orient_faces(moebius()) is None


def test_components_are_refused_with_their_areas_and_shares():
    verts = [*GRID, [5, 0, 0], [6, 0, 0], [5, 0.5, 0]]
    with pytest.raises(MeshError, match=r"two\.off: 2 components with areas 1, 0\.25 in .*80%, 20% of") as error:
        check_mesh(Mesh.from_arrays(verts, [*TWO, [4, 5, 6]], name="two.off"))
    assert "weld" not in str(error.value)


def test_areas_of_components_are_in_the_units_of_the_file_and_the_first_five_are_named():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    verts = np.concatenate([20 * corners + [30 * k, 0, 0] for k in range(6)])
    verts[:3] /= 3  # 22.2 instead of 200
    with pytest.raises(MeshError, match=r"6 components with areas 200, 200, 200, 200, 200, \.\.\. in squared units"):
        check_mesh(Mesh.from_arrays(verts, np.arange(18).reshape(-1, 3)))
    with pytest.raises(MeshError, match=r"2 components with areas 200, 22\.2 in squared units of the file \(90%, 10%"):
        check_mesh(Mesh.from_arrays(verts[:6], [[0, 1, 2], [3, 4, 5]]))


def test_a_seam_is_refused_with_the_cure_named():
    verts = [*GRID[:3], *GRID[1:]]
    mesh = Mesh.from_arrays(verts, [[0, 1, 2], [3, 5, 4]], name="seam")
    with pytest.raises(MeshError, match=r"2 components .* 2 vertices repeat .*weld\) would leave 1 component$"):
        check_mesh(mesh)
    welded, index = weld(mesh)
    assert index.tolist() == [0, 1, 2, 1, 2, 3]
    assert torch.equal(welded.verts[index], mesh.verts)
    assert check_mesh(welded).n_duplicate_verts == 0


def test_weld_takes_minus_zero_for_zero_and_nothing_else():
    mesh = Mesh.from_arrays([[0.0, 1, 2], [-0.0, 1, 2], [1e-300, 1, 2]], [[0, 1, 2]])
    assert weld(mesh)[1].tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("verts", "faces", "fault"),
    [
        (np.zeros((0, 3)), [[0, 1, 2]], "no vertices"),
        (GRID, np.zeros((0, 3)), "no faces"),
        ([[0, 0, 0], [np.nan, 0, 0], [0, np.inf, 0]], [[0, 1, 2]], "2 of 3 vertices .* first is vertex 1"),
        (GRID, [[0, 1, 2], [0, 1, 4]], "face 1 refers to vertex 4, but there are 4 vertices"),
        (GRID, [[0, 1, -1]], "face 0 refers to vertex -1"),
        ([[1, 1, 1]] * 3, [[0, 1, 2]], "no area"),
        (GRID, [[0, 0, 1], [2, 2, 2]], "no area"),
        ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], "no area"),
    ],
)
def test_what_cannot_be_used_is_refused(verts, faces, fault):
    with pytest.raises(MeshError, match=f"^shape: .*{fault}"):
        check_mesh(Mesh.from_arrays(verts, faces, name="shape"))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.lists(st.integers(0, 6), min_size=3, max_size=3), min_size=1, max_size=14))
def test_counts_agree_with_a_slow_count(faces):
    verts = np.random.default_rng(0).normal(size=(7, 3))
    report = inspect_mesh(Mesh.from_arrays(verts, faces))
    sets = {frozenset(f) for f in faces if len(set(f)) == 3}
    edges = [frozenset(e) for f in sets for e in ((a, b) for a in f for b in f if a < b)]
    use = {e: edges.count(e) for e in set(edges)}
    assert report.n_faces - (report.n_degenerate - report.n_flat) - report.n_repeated == len(sets)
    assert report.n_boundary_edges == sum(n == 1 for n in use.values())
    assert report.n_nonmanifold_edges == sum(n > 2 for n in use.values())
    assert report.n_unreferenced == 7 - len(set().union(*sets))
    fans = 0
    for v in range(7):
        rest = [f - {v} for f in sets if v in f]  # the link of v: faces are joined where links share a vertex
        groups = []
        for link in rest:
            joined = [g for g in groups if g & link]
            groups = [g for g in groups if not g & link] + [frozenset().union(link, *joined)]
        fans += len(groups) > 1
    assert report.n_nonmanifold_verts == fans
