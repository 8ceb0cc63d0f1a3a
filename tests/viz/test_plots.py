import sys

import matplotlib.figure
import numpy as np
import pytest
import torch
from PIL import Image

from torchqm.geometry.mesh import Mesh
from torchqm.viz import (
    bar_figure,
    curve_points,
    error_curves,
    line_figure,
    match_figure,
    scalar_figure,
    symmetry_figure,
    xyz_colors,
)
from torchqm.viz import charts as charts_module


def octahedron(stretch=(1.0, 2.0, 3.0)):
    verts = np.concatenate([np.eye(3), -np.eye(3)]) * stretch
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    return Mesh.from_arrays(verts, faces)


IDENTITY = torch.arange(6)
MIRROR = torch.tensor([3, 1, 2, 0, 4, 5])  # x to -x


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Few triangles and few pixels: the figures here need no smooth shading."""
    monkeypatch.setattr(charts_module, "DPI", 60)
    monkeypatch.setattr("torchqm.viz.render.REFINE_BELOW", 0)


@pytest.fixture
def drawn(monkeypatch):
    """What each figure held when it was saved: axes with triangles, and all its texts."""
    seen = []
    save = matplotlib.figure.Figure.savefig

    def spy(figure, *args, **options):
        panels = [ax for ax in figure.axes if ax.collections and len(ax.collections[0].get_paths()) == 4]
        texts = [text.get_text() for text in figure.texts] + [t.get_text() for ax in figure.axes for t in ax.texts]
        seen.append({"panels": panels, "texts": texts, "axes": list(figure.axes), "size": figure.get_size_inches()})
        seen[-1]["faces"] = [ax.collections[0].get_facecolors().copy() for ax in panels]
        seen[-1]["xlims"] = [ax.get_xlim() for ax in figure.axes if ax not in panels]
        seen[-1]["ticks"] = [[t.get_text() for t in ax.get_xticklabels()] for ax in figure.axes if ax not in panels]
        seen[-1]["yscale"] = figure.axes[0].get_yscale()
        seen[-1]["lines"] = [(*line.get_data(), line.get_label()) for ax in figure.axes for line in ax.lines]
        return save(figure, *args, **options)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", spy)
    return seen


def test_match_figure_draws_target_and_maps_from_the_front_and_behind(tmp_path, drawn):
    mesh = octahedron()
    path = match_figure(
        mesh, mesh, torch.stack([IDENTITY, MIRROR]), ["direct", "mirrored"], tmp_path / "a.png", [0.1, 0.25]
    )
    assert path == tmp_path / "a.png"
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]  # no temporary file is left
    assert len(drawn[0]["panels"]) == 6
    assert {"target", "direct (0.1)", "mirrored (0.25)"} <= set(drawn[0]["texts"])
    with Image.open(path) as image:
        image.load()
        assert image.size == pytest.approx(drawn[0]["size"] * 60, abs=1)
    target, direct, mirrored = drawn[0]["faces"][:3]
    np.testing.assert_allclose(direct, target)
    assert np.abs(mirrored - target).max() > 0.1


@pytest.mark.parametrize(("count", "shown"), [(1, 4), (3, 4), (8, 9), (16, 17), (20, 17)])
def test_match_figure_has_one_panel_per_map(count, shown, tmp_path, drawn):
    mesh = octahedron()
    match_figure(
        mesh, mesh, IDENTITY.repeat(count, 1).numpy(), ["unknown"] * count, tmp_path / "a.png", title="octahedra"
    )
    assert len(drawn[0]["panels"]) == shown
    assert ("octahedra: the first 16 of 20 maps" in drawn[0]["texts"]) == (count == 20)


def test_match_figure_pulls_the_targets_colours_back(tmp_path, drawn):
    target = octahedron()
    order = torch.tensor([4, 2, 0, 5, 1, 3])  # the source numbers the same points otherwise
    source = Mesh(target.verts[order], torch.argsort(order)[target.faces])
    match_figure(source, target, order[None], ["direct"], tmp_path / "a.png")
    of_target, of_source = (np.unique(c.round(6), axis=0) for c in drawn[0]["faces"][:2])
    np.testing.assert_allclose(of_source, of_target, atol=1e-5)


def test_symmetry_figure_skips_the_identity_and_adds_the_displacement_of_a_reflection(tmp_path, drawn):
    mesh = octahedron()
    symmetry_figure(mesh, torch.stack([IDENTITY, MIRROR]), tmp_path / "a.png", ["identity", "reflection"])
    assert len(drawn[0]["panels"]) == 3
    assert "reflection" in drawn[0]["texts"]
    assert "identity" not in drawn[0]["texts"]
    assert drawn[0]["xlims"][-1] == pytest.approx((0, 2 / mesh.area**0.5))
    other = torch.tensor([0, 4, 2, 3, 1, 5])
    symmetry_figure(mesh, torch.stack([IDENTITY, MIRROR, other]), tmp_path / "b.png")
    assert len(drawn[1]["panels"]) == 3
    assert len(drawn[1]["axes"]) == 3  # no colour bar


def test_scalar_figure_gives_each_kind_of_field_its_colour_bar(tmp_path, drawn):
    mesh = octahedron()
    fields = {
        "distance": torch.arange(6.0),
        "signed": mesh.verts[:, 0] * 2,
        "clusters": torch.tensor([5, 5, 5, 7, 7, 7]),
        "left": np.array([True, False, False, False, True, True]),
        "constant": np.ones(6),
        "symmetry": xyz_colors(mesh)[MIRROR],
    }
    scalar_figure(mesh, fields, tmp_path / "a.pdf")
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    assert len(drawn[0]["panels"]) == 6
    assert len(drawn[0]["xlims"]) == 5
    assert drawn[0]["xlims"][0] == pytest.approx((0, 5))
    assert drawn[0]["xlims"][1] == pytest.approx((-2, 2))
    assert drawn[0]["ticks"][2] == ["5", "7"]


def test_points_of_a_curve_count_exactly():
    x, y = curve_points(torch.tensor([0.1, 0.0, 0.2, 0.9]).double().round(decimals=6), xlim=0.2)
    assert (x[0], x[-1]) == (0, 0.2)
    assert (y[0], y[249], y[250], y[-1]) == (0.25, 0.25, 0.5, 0.75)


def test_error_curves_draw_the_curves_with_their_means(tmp_path, drawn):
    error_curves({"ours": np.array([0.0, 0.02]), "BIM": [0.1, 0.4]}, tmp_path / "a.png", title="cat")
    (x, y, label), (_, y_bim, label_bim) = drawn[0]["lines"]
    assert (label, label_bim) == ("ours (mean 0.0100)", "BIM (mean 0.2500)")
    assert (x[-1], y[0], y[-1], y_bim[0], y_bim[-1]) == (0.25, 0.5, 1.0, 0.0, 0.5)


def test_line_and_bar_figures(tmp_path, drawn):
    k = np.arange(3)
    series = {"all": (k, k + 1.0), "symmetric": (k, torch.tensor([3.0, 2, 1]))}
    line_figure(series, tmp_path / "a.png", "k", "error", {"symmetric": {"linestyle": "--"}}, yscale="log")
    np.testing.assert_array_equal(drawn[0]["lines"][1][1], [3, 2, 1])
    assert drawn[0]["yscale"] == "log"
    bar_figure({"cat": {"ours": 0.02, "BIM": 0.03}, "wolf": {"ours": 0.01}}, tmp_path / "b.png", "mean error")
    assert (tmp_path / "b.png").stat().st_size > 1000


def test_a_failed_save_leaves_the_old_picture_and_no_other_file(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    error_curves({"ours": [0.1]}, path)
    before = path.read_bytes()

    def broken(figure, file, **options):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", broken)
    with pytest.raises(OSError, match="disk full"):
        error_curves({"ours": [0.2]}, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_folders_are_made_and_pyplot_is_left_alone(tmp_path):
    had = "matplotlib.pyplot" in sys.modules
    assert error_curves({"ours": [0.1]}, tmp_path / "new" / "folder" / "a.png").is_file()
    assert ("matplotlib.pyplot" in sys.modules) == had
    assert "pyplot" not in vars(charts_module)


MESH = octahedron()
TWO = torch.stack([IDENTITY, MIRROR])


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda p: match_figure(MESH, MESH, TWO[:, :5], ["a", "b"], p), "maps"),
        (lambda p: match_figure(MESH, MESH, TWO + 3, ["a", "b"], p), "maps"),
        (lambda p: match_figure(MESH, MESH, TWO, ["a"], p), "labels"),
        (lambda p: match_figure(MESH, MESH, TWO, ["a", "b"], p, scores=[1.0]), "scores"),
        (lambda p: match_figure(MESH, MESH, TWO, ["a", "b"], p.with_suffix(".xyz")), "path"),
        (lambda p: symmetry_figure(MESH, TWO - 1, p), "maps"),
        (lambda p: symmetry_figure(MESH, TWO, p, labels=["a"]), "labels"),
        (lambda p: scalar_figure(MESH, {"f": np.ones(5)}, p), r"fields\['f'\]"),
        (lambda p: scalar_figure(MESH, {}, p), "fields"),
        (lambda p: error_curves({}, p), "curves"),
        (lambda p: error_curves({"a": [0.1, np.nan]}, p), r"curves\['a'\]"),
        (lambda p: error_curves({"a": []}, p), r"curves\['a'\]"),
        (lambda p: error_curves({"a": [-0.1]}, p), r"curves\['a'\]"),
        (lambda p: line_figure({}, p, "x", "y"), "series"),
        (lambda p: line_figure({"a": ([1, 2], [1])}, p, "x", "y"), r"series\['a'\]"),
        (lambda p: line_figure({"a": ([1], [1])}, p, "x", "y", styles={"b": {}}), "styles"),
        (lambda p: line_figure({"a": ([1], [1])}, p, "x", "y", yscale="cubic"), "yscale"),
        (lambda p: bar_figure({}, p, "y"), "groups"),
    ],
)
def test_misfits_are_named_and_nothing_is_written(call, name, tmp_path):
    with pytest.raises(ValueError, match=f"^{name}: "):
        call(tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
