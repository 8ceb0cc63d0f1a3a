import json

import numpy as np
import pytest
import torch
from references import shapes

from torchqm.cli.main import main
from torchqm.geometry import Mesh, save_mesh

FAST = ["--no-picture", "--k-max", "40", "--samples", "300"]


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A bumpy ellipsoid with one mirror plane, and a copy with other vertex numbers; the exact map between them."""
    folder = tmp_path_factory.mktemp("pair")
    x = shapes.blob(2)
    copy = shapes.renumbered(x, 4)
    save_mesh(x.mesh, folder / "x.off")
    save_mesh(copy.shape.mesh, folder / "y.off")
    save_mesh(shapes.blob(1).mesh, folder / "odd.off")
    np.save(folder / "sx.npy", x.group.maps[1].numpy())
    np.savez(folder / "sy.npz", maps=copy.shape.group.maps.numpy())
    return folder, copy


def run(pair, tmp_path, *options, source="x.off", target="y.off"):
    folder, _ = pair
    named = [str(folder / o) if (folder / o).exists() else str(o) for o in options]
    return main(["match", str(folder / source), str(folder / target), "--out", str(tmp_path / "out"), *FAST, *named])


@pytest.mark.parametrize(
    "symmetry", [[], ["--symmetry", "sy.npz", "--symmetry-source", "sx.npy"]], ids=["plane", "file"]
)
def test_both_maps_are_found_and_written(pair, tmp_path, capsys, symmetry):
    assert run(pair, tmp_path, *symmetry) == 0
    _, copy = pair
    with np.load(tmp_path / "out" / "match.npz", allow_pickle=False) as saved:
        assert saved["labels"].tolist() == ["direct", "mirrored"]
        assert saved["maps"].dtype == np.int64
        maps = torch.from_numpy(saved["maps"])
        assert saved["orbits"].tolist() == saved["maps"].T.tolist()
        assert saved["symmetry_source"].shape == saved["symmetry_target"].shape == (2, 642)
        assert set(saved) >= {"scores", "fmaps", "fmap_even", "orientation"}
    verts = copy.shape.mesh.verts
    for row, truth in zip(maps, copy.shape.group.maps[:, copy.p2p_xy], strict=True):
        assert float((verts[row] - verts[truth]).norm(dim=1).mean()) / copy.shape.mesh.area**0.5 < 0.02
    out, err = capsys.readouterr()
    assert "0 direct" in out
    assert "1 mirrored" in out
    assert "quotient matching" in out
    assert "s left" in err
    assert not (tmp_path / "out" / "match.png").exists()


def test_prepared_eigenpairs_are_used_and_change_nothing(pair, tmp_path, monkeypatch):
    folder, _ = pair
    cache = tmp_path / "cache"
    argv = ["prepare", str(folder), "--k", "40", "--cache", str(cache), "--jobs", "1"]
    assert main(argv) == 0
    entries = {path.name: path.stat().st_mtime_ns for path in cache.glob("*.npz")}
    assert len(entries) == 3
    monkeypatch.setattr("torchqm.spectral.cache.eigenbasis_and_note", None)  # nothing can be computed
    assert run(pair, tmp_path, "--cache", cache) == 0
    assert {path.name: path.stat().st_mtime_ns for path in cache.glob("*.npz")} == entries
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["details"]["source"]["laplacian"].endswith(", from the cache")
    with np.load(tmp_path / "out" / "match.npz") as saved:
        maps = saved["maps"]
    argv = ["symmetry", str(folder / "x.off"), "--cache", str(cache), "--out", str(tmp_path / "symmetry"), *FAST]
    assert main(argv) == 0
    monkeypatch.undo()
    assert run(pair, tmp_path) == 0
    with np.load(tmp_path / "out" / "match.npz") as saved:
        assert saved["maps"].tolist() == maps.tolist()


def test_summary_has_what_is_needed_to_judge_and_repeat_the_run(pair, tmp_path):
    assert run(pair, tmp_path, "--k", "20", "--seed", "3") == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["parameters"]["k"] == 20
    assert summary["parameters"]["seed"] == 3
    assert summary["parameters"]["n_samples"] == 300
    assert summary["arguments"]["command"] == "match"
    assert {"torchqm", "torch", "numpy", "scipy", "python"} <= summary["versions"].keys()
    assert summary["warnings"] == []
    assert all(seconds >= 0 for seconds in summary["seconds"].values())
    assert [m["label"] for m in summary["maps"]] == ["direct", "mirrored"]


def test_picture_is_drawn(pair, tmp_path, monkeypatch):
    monkeypatch.setattr("torchqm.viz.charts.DPI", 40)
    monkeypatch.setattr("torchqm.viz.render.REFINE_BELOW", 0)
    folder, _ = pair
    out = tmp_path / "out"
    assert main(["match", str(folder / "x.off"), str(folder / "x.off"), "--out", str(out), *FAST[1:]]) == 0
    assert (out / "match.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert {p.name for p in out.iterdir()} == {"match.npz", "match.png", "summary.json"}


@pytest.mark.parametrize("method", ["paper", "semi"])
def test_other_methods(pair, tmp_path, method):
    assert run(pair, tmp_path, "--method", method) == 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["method"] == method


def test_no_symmetry_gives_one_map_and_a_warning(pair, tmp_path, capsys):
    assert run(pair, tmp_path, "--symmetry", "none", source="odd.off", target="odd.off") == 0
    assert np.load(tmp_path / "out" / "match.npz")["maps"].shape == (1, 642)
    warnings = json.loads((tmp_path / "out" / "summary.json").read_text())["warnings"]
    assert any("no symmetry is used" in text for text in warnings)
    assert "torchqm: warning: no symmetry is used" in capsys.readouterr().err


def test_few_vertices_lower_the_final_basis_and_say_so(tmp_path, capsys):
    save_mesh(shapes.box().mesh, tmp_path / "box.off")
    n = shapes.box().mesh.n_verts
    argv = ["match", str(tmp_path / "box.off"), str(tmp_path / "box.off"), "--no-picture", "--symmetry", "none"]
    assert main([*argv, "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["parameters"]["k_max"] == n // 2
    assert f"{n} vertices: the refinement stops at {n // 2} eigenfunctions instead of 200" in summary["warnings"][0]
    assert "refinement stops" in capsys.readouterr().err


def fails(capsys, argv, *parts):
    """The command ends with status 2 and one line on stderr that has all the parts."""
    assert main(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("torchqm: error: ")
    for part in parts:
        assert part in lines[0], lines[0]


CUBE = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n3 0 2 3\n3 1 2 3\n"
BAD_MESHES = {
    "missing": (None, ["no such file"]),
    "empty": ("", ["empty"]),
    "truncated": (CUBE[:40], []),
    "text": ("hello\n", []),
    "index": (CUBE.replace("3 1 2 3", "3 1 2 9"), ["refers to vertex 9", "4 vertices"]),
    "nan": (CUBE.replace("0 0 1", "0 nan 1"), ["NaN or infinite", "vertex 3"]),
    "no faces": ("OFF\n4 0 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n", ["no faces"]),
    "few vertices": (CUBE, ["4 vertices are fewer than the 30 eigenfunctions", "--k 30"]),
    "small": (
        CUBE.replace("1 0 0", "1e-100 0 0").replace("0 1 0", "0 1e-100 0").replace("0 0 1", "0 0 1e-100"),
        ["too small", "1e-100", "rescale"],
    ),
    "large": (CUBE.replace("0 0 0", "0 0 -1e308").replace("0 0 1", "0 0 1e308"), ["too large", "1.8e+308", "rescale"]),
    "lines": (CUBE + "3 0 1 2\n", ["declares 4 vertices and 4 faces", "8 lines", "9 follow", "line 11"]),
    "no area": (CUBE.replace("1 0 0", "0 0 0").replace("0 1 0", "0 0 0").replace("0 0 1", "0 0 0"), ["no area"]),
}


@pytest.mark.parametrize("which", ["source", "target", "reference"])
@pytest.mark.parametrize("fault", BAD_MESHES)
def test_bad_meshes(pair, tmp_path, capsys, fault, which):
    content, parts = BAD_MESHES[fault]
    bad, good = tmp_path / "bad.off", str(pair[0] / "x.off")
    if content is not None:
        bad.write_text(content)
    places = {
        "source": [str(bad), good],
        "target": [good, str(bad)],
        "reference": [good, good, "--reference", str(bad)],
    }
    fails(capsys, ["match", *places[which], "--out", str(tmp_path / "o" / "out"), *FAST], str(bad), *parts)
    assert {p.name for p in tmp_path.iterdir()} <= {"bad.off"}


def test_several_components_are_counted_with_their_areas(pair, tmp_path, capsys):
    ball = shapes.icosphere(2)
    verts, faces = ball.numpy()
    two = Mesh.from_arrays(np.concatenate([verts, 3 + verts / 3]), np.concatenate([faces, faces + len(verts)]))
    save_mesh(two, tmp_path / "two.off")
    argv = ["match", str(tmp_path / "two.off"), str(pair[0] / "x.off"), "--out", str(tmp_path / "out")]
    fails(capsys, argv, "two.off", "2 components", f"areas {ball.area:.3g}, {ball.area / 9:.3g} in", "90%", "10%")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--symmetry", "--symmetry-source"])
def test_bad_symmetry_files(pair, tmp_path, capsys, option):
    folder = pair[0]
    meshes = [str(folder / "x.off"), str(folder / "x.off")]
    out = ["--out", str(tmp_path / "out"), *FAST]
    bad = tmp_path / "s.npy"
    argv = ["match", *meshes, option, str(bad), *out]
    fails(capsys, argv, "s.npy", "no such file")
    np.save(bad, np.arange(5))
    fails(capsys, argv, "s.npy", "5 entries", "642 vertices")
    np.save(bad, np.full(642, 7))
    fails(capsys, argv, "s.npy", "no permutation (641 of 642 ids repeat)")
    np.save(bad, shapes.blob(8).group.maps[[0, 1, 2]].numpy())
    fails(capsys, argv, "s.npy", "the 3 maps are no group")
    assert not (tmp_path / "out").exists()


def test_output_folder_that_is_a_file(pair, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert run(pair, tmp_path) == 2
    assert "out: is a file" in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "part"),
    [
        (["--k", "2"], "k=2"),
        (["--k", "50"], "k_max=40"),
        (["--k-max", "700"], "642 vertices are fewer than the 700 eigenfunctions asked for (--k-max 700)"),
        (["--splits", "-1"], "splits=-1"),
        (["--symmetry", "none", "--symmetry-source", "sx.npy"], "--symmetry none"),
    ],
)
def test_numbers_that_are_not_allowed(pair, tmp_path, capsys, options, part):
    assert run(pair, tmp_path, *options) == 2
    assert part in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_interrupt_leaves_nothing(pair, tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchqm.matching.match", interrupt)
    assert run(pair, tmp_path) == 130
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    from torchqm.learn import MatchNet, NetOptions, save_net

    torch.manual_seed(0)
    net = MatchNet(NetOptions(k=30, signature=32, channels=32, width=32))
    return save_net(net, tmp_path_factory.mktemp("net") / "net.safetensors")


def test_a_checkpoint_gives_the_descriptors(pair, tmp_path, learned):
    from torchqm.learn import LearnedDescriptors, load_net

    assert run(pair, tmp_path, "--checkpoint", learned) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["details"]["descriptors"] == repr(LearnedDescriptors(load_net(learned)))
    assert summary["details"]["n_descriptors"] == 32
    assert summary["arguments"]["checkpoint"] == str(learned)
    _, copy = pair
    with np.load(tmp_path / "out" / "match.npz", allow_pickle=False) as saved:
        found = torch.from_numpy(saved["maps"])[0]
    verts = copy.shape.mesh.verts
    assert float((verts[found] - verts[copy.p2p_xy]).norm(dim=1).mean()) / copy.shape.mesh.area**0.5 < 0.02


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--checkpoint", "none.ckpt"), "none.ckpt: no such file or run folder"),
        (("--checkpoint", "x.off"), "x.off: a trained network is a .safetensors or a .ckpt"),
        (("--checkpoint", "LEARNED", "--descriptor", "hks"), "--checkpoint takes the place of --descriptor hks"),
        (("--checkpoint", "LEARNED", "--k-max", "29", "--k", "20"), "29 eigenfunctions are there, and the network was"),
    ],
)
def test_checkpoints_that_cannot_be_used_are_named(pair, tmp_path, capsys, learned, options, message):
    given = [learned if option == "LEARNED" else option for option in options]
    assert run(pair, tmp_path, *given) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
