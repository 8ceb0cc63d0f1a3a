import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchqm.geometry.mesh import Mesh
from torchqm.viz import View, auto_frame, project, render_mesh, xyz_colors
from torchqm.viz.camera import up_scores
from torchqm.viz.render import _surface, to_rgb

RED, BLUE, GREEN = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
STRAIGHT = View(elev=0, azim=0)


@pytest.fixture(autouse=True)
def coarse(monkeypatch, request):
    """Draw triangles as they are; the refinement of coarse meshes has its own test."""
    if "refine" not in request.node.name:
        monkeypatch.setattr("torchqm.viz.render.REFINE_BELOW", 0)


def sphere(n=16):
    """A closed sphere, outward triangles, z through the poles."""
    lat, lon = np.meshgrid(np.linspace(0, np.pi, n + 1)[1:-1], np.arange(2 * n) * np.pi / n, indexing="ij")
    ring = np.stack([np.sin(lat) * np.cos(lon), np.sin(lat) * np.sin(lon), np.cos(lat)], -1).reshape(-1, 3)
    verts = np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]])
    m, faces = 2 * n, []
    for j in range(m):
        k = (j + 1) % m
        faces.append((len(ring), j, k))
        faces.append((len(ring) + 1, (n - 2) * m + k, (n - 2) * m + j))
        for i in range(n - 2):
            a, b, c, d = i * m + j, i * m + k, (i + 1) * m + j, (i + 1) * m + k
            faces += [(a, c, b), (b, c, d)]
    return Mesh.from_arrays(verts, faces)


def quadruped():
    """Boxes: a long body along x on four legs, a head at +x; y is up."""
    boxes = [((-2, 1, -0.5), (2, 2, 0.5)), ((2, 1.7, -0.3), (2.8, 2.8, 0.3))]
    boxes += [((x, 0, z), (x + 0.2, 1, z + 0.2)) for x in (-2, 1.8) for z in (-0.5, 0.3)]
    verts, faces = [], []
    cube = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    cube += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    for low, high in boxes:
        faces += [[8 * (len(verts) // 8) + i for i in tri] for tri in cube]
        verts += [
            [(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)
        ]
    return Mesh.from_arrays(verts, faces)


def pixels(mesh, colors=None, size=100, **options):
    figure = Figure((1, 1), dpi=size)
    canvas = FigureCanvasAgg(figure)
    render_mesh(figure.add_axes((0, 0, 1, 1)), mesh, colors, **({"view": STRAIGHT, "up": "z"} | options))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3] / 255.0


def halves(mesh):
    x = mesh.verts[:, 0].numpy()
    return np.where(x[:, None] < 0, RED, BLUE)


def test_red_left_and_blue_right_from_the_front_and_swapped_from_behind():
    mesh = sphere()
    front, back = (pixels(mesh, halves(mesh), view=view, shade=False) for view in (STRAIGHT, STRAIGHT.behind()))
    np.testing.assert_allclose([front[50, 25], front[50, 75]], [RED, BLUE], atol=0.02)
    np.testing.assert_allclose([back[50, 25], back[50, 75]], [BLUE, RED], atol=0.02)
    np.testing.assert_allclose(front[2, 2], 1.0)  # outside the sphere


@pytest.mark.parametrize(("azim", "left"), [(90, (0, -1, 0)), (-90, (0, 1, 0))])
def test_azim_turns_towards_the_right(azim, left):
    # z up: front is -y, right is x; from the right (azim 90, the camera at +x) -y lies to the left
    mesh = Mesh.from_arrays([left, [0, 0, 1], [1, 0, 0]], [[0, 1, 2]])
    assert project(mesh, View(0, azim), "z")[0] == pytest.approx([-1, 0, 0], abs=1e-12)


def test_elev_looks_down_on_the_shape():
    mesh = sphere()
    top = np.where(mesh.verts[:, 2:].numpy() > 0.0, RED, BLUE)
    above = pixels(mesh, top, view=View(elev=90, azim=0), shade=False)
    np.testing.assert_allclose(above[50, 50], RED, atol=0.02)
    assert (above[:, :, 2] - above[:, :, 0]).max() < 0.9  # nothing of the lower half


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_every_up_is_drawn_upwards_in_a_right_handed_frame(up):
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    mesh = Mesh.from_arrays(np.concatenate([np.eye(3), axis[None]]), [[0, 1, 2]])
    for azim in (0, 50, 200):
        seen = project(mesh, View(0, azim), up)
        assert seen[3] == pytest.approx([0, 1, 0], abs=1e-12)
        assert np.linalg.det(seen[:3]) == pytest.approx(1)  # a rotation, not a mirror image


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_near_triangle_hides_the_far_one(order):
    near = [[-1.0, -1, -1], [1, -1, -1], [0, -1, 1]]  # the camera is at y = -infinity
    far = [[-1.0, 1, -1], [1, 1, -1], [0, 1, 1]]
    both = np.array([near, far])[list(order)].reshape(-1, 3)
    colors = np.repeat(np.array([RED, GREEN])[list(order)], 3, axis=0)
    image = pixels(Mesh.from_arrays(both, [[0, 1, 2], [3, 4, 5]]), colors, shade=False)
    np.testing.assert_allclose(image[60, 50], RED, atol=0.02)


def test_culling_halves_a_closed_sphere_and_keeps_the_picture():
    mesh = sphere()
    axes = Figure().subplots(1, 3)
    counts = [
        len(render_mesh(ax, mesh, up="z", cull=cull).get_paths())
        for ax, cull in zip(axes, (True, False, "auto"), strict=True)
    ]
    assert counts[0] == counts[2]
    assert counts[0] < 0.6 * counts[1]
    kept, all_drawn = (pixels(mesh, halves(mesh), cull=cull)[22:78, 22:78] for cull in (True, False))
    np.testing.assert_allclose(kept, all_drawn, atol=0.05)


def test_an_inside_out_or_mixed_orientation_gives_the_same_picture():
    mesh = sphere()
    colors = np.where(mesh.verts[:, 1:2].numpy() < 0, RED, BLUE)  # red towards the camera
    inside_out = Mesh(mesh.verts, mesh.faces.flip(1))
    mixed = mesh.faces.clone()
    mixed[::2] = mixed[::2].flip(1)
    expected = pixels(mesh, colors, shade=False)
    np.testing.assert_allclose(expected[50, 50], RED, atol=0.02)
    for other in (inside_out, Mesh(mesh.verts, mixed)):
        np.testing.assert_allclose(pixels(other, colors, shade=False)[20:80, 20:80], expected[20:80, 20:80], atol=0.25)
    # trusting the orientation shows the far side of the inside-out sphere
    np.testing.assert_allclose(pixels(inside_out, colors, shade=False, cull=True)[50, 50], BLUE, atol=0.02)


def test_parts_are_turned_outwards_one_by_one():
    mesh = sphere(8)
    n = mesh.n_verts
    faces = torch.cat([mesh.faces, mesh.faces.flip(1) + n])
    _, turned, consistent, closed = _surface(torch.cat([mesh.verts, mesh.verts + 5]).numpy(), faces.numpy())
    assert (consistent, closed) == (True, True)
    np.testing.assert_array_equal(np.sort(turned[len(mesh.faces) :] - n, 1), np.sort(mesh.faces.numpy(), 1))
    both = Mesh.from_arrays(np.concatenate([mesh.verts, mesh.verts]), turned)
    np.testing.assert_allclose(both.face_normals[: mesh.n_faces], both.face_normals[mesh.n_faces :], atol=1e-12)


def test_small_holes_are_filled_and_large_ones_are_not():
    mesh = sphere()
    small = Mesh(mesh.verts, mesh.faces[1:])
    _, faces, _, closed = _surface(small.verts.numpy(), small.faces.numpy())
    assert closed
    assert len(faces) == mesh.n_faces - 1 + 3
    half = Mesh(mesh.verts, mesh.faces[(mesh.verts[mesh.faces][:, :, 1] > -1e-9).all(1)])  # open towards the camera
    image = pixels(half, np.tile(GREEN, (mesh.n_verts, 1)), shade=False)
    np.testing.assert_allclose(image[50, 50], GREEN, atol=0.02)  # its inside is drawn


def test_shading_is_brighter_from_above_left_and_off_on_request():
    mesh = sphere()
    shaded = pixels(mesh).mean(2)
    assert shaded[30, 35] > shaded[75, 70] + 0.15
    plain = pixels(mesh, shade=False)
    assert np.ptp(plain[30:70, 30:70].reshape(-1, 3), axis=0).max() < 0.02


def test_the_surface_has_no_seams():
    mesh = sphere(40)
    image = pixels(mesh, np.zeros((mesh.n_verts, 3)), shade=False, size=200)
    assert image[50:150, 50:150].max() < 0.02  # black all over, on white paper


def test_coarse_meshes_are_refined_so_that_colours_run_smoothly():
    mesh = Mesh.from_arrays([[-1, 0, -1], [1, 0, -1], [0, 0, 1]], [[0, 1, 2]])
    image = pixels(mesh, np.array([RED, BLUE, GREEN]), shade=False)
    assert image[80, 20, 0] > 0.65 > 0.45 > image[80, 50, 0] > 0.35 > 0.2 > image[80, 80, 0]


def test_a_standing_shape_is_seen_upright_from_its_long_side():
    mesh = quadruped()
    for turn in (torch.eye(3, dtype=torch.float64), torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).double()):
        moved = mesh.moved(mesh.verts @ turn.T)  # y up, then z up
        right, up, front = auto_frame(moved)
        np.testing.assert_allclose(up, turn[:, 1], atol=1e-12)
        np.testing.assert_allclose(right, turn[:, 0], atol=1e-12)  # the head, at +x, is on the side the camera turns to
        np.testing.assert_allclose(np.cross(right, up), front, atol=1e-12)
        assert up_scores(moved).max() == pytest.approx(up_scores(mesh).max())


def test_a_flat_shape_is_seen_from_above():
    mesh = Mesh.from_arrays([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    assert np.ptp(project(mesh, STRAIGHT), axis=0) == pytest.approx([2, 1, 0])


def test_xyz_colors_follow_the_coordinates_and_ignore_scale_place_and_stray_vertices():
    mesh = sphere()
    colors = xyz_colors(mesh)
    assert colors.min() >= 0
    assert colors.max() <= 1
    right, left = colors[mesh.verts[:, 0].argmax()], colors[mesh.verts[:, 0].argmin()]
    assert right[0] - right[2] > left[0] - left[2] + 0.2  # redder where x is large
    np.testing.assert_allclose(xyz_colors(mesh.moved(7 * mesh.verts + 3)), colors, atol=1e-9)
    stray = Mesh(torch.cat([mesh.verts, torch.full((1, 3), 99.0)]), mesh.faces)
    np.testing.assert_allclose(xyz_colors(stray)[:-1], colors)


def test_scalars_go_through_the_colour_map_and_nan_is_neutral():
    rgb = to_rgb(torch.tensor([0.0, 5.0, 10.0, torch.nan]), 4, cmap="gray", limits=(0, 10))
    np.testing.assert_allclose(rgb[:3, 0], [0, 0.5, 1], atol=0.01)
    np.testing.assert_allclose(rgb[3], to_rgb(None, 1)[0])


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"colors": np.zeros(3)}, "colors"),
        ({"colors": np.full((450, 3), 2.0)}, "colors"),
        ({"up": "w"}, "up"),
        ({"up": "--z"}, "up"),
        ({"up": np.ones((3, 3))}, "up"),
    ],
)
def test_misfits_are_named(options, name):
    mesh = sphere(15)
    if name == "colors" and len(options["colors"]) == 450:
        options = {"colors": np.full((mesh.n_verts, 3), 2.0)}
    with pytest.raises(ValueError, match=f"^{name}: "):
        render_mesh(Figure().add_subplot(), mesh, **options)


def test_a_mesh_without_faces_is_refused():
    with pytest.raises(ValueError, match="without faces"):
        render_mesh(Figure().add_subplot(), Mesh.from_arrays(np.eye(3), np.zeros((0, 3))))
