import json

import numpy as np
import pytest
import torch
from references import shapes

from torchqm.cli.main import main
from torchqm.data.synthetic import creature
from torchqm.geometry import save_mesh

FAST = ["--k-max", "40", "--samples", "300"]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A shape with a mirror plane, a creature at rest and in a pose without plane."""
    folder = tmp_path_factory.mktemp("files")
    save_mesh(shapes.blob(2).mesh, folder / "blob.off")
    save_mesh(creature("quadruped", 1000).mesh, folder / "rest.off")
    save_mesh(creature("quadruped", 1000, pose=1).mesh, folder / "posed.off")
    return folder


def test_own_mirror_plane_and_the_file_goes_into_match(files, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["symmetry", str(files / "blob.off"), "--out", str(out), "--no-picture", *FAST]) == 0
    with np.load(out / "symmetry.npz", allow_pickle=False) as saved:
        assert set(saved) == {"maps", "labels", "scores", "fmaps"}
        assert saved["maps"].tolist() == shapes.blob(2).group.maps.tolist()
        assert saved["labels"].tolist() == ["direct", "mirrored"]
        assert saved["scores"][0] == pytest.approx(0, abs=1e-9)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["origin"] == "extrinsic"
    assert summary["order"] == 2
    assert "found by: extrinsic" in capsys.readouterr().out
    blob, given = str(files / "blob.off"), str(out / "symmetry.npz")
    argv = ["match", blob, blob, "--symmetry", given, "--out", str(tmp_path / "match"), "--no-picture", *FAST]
    assert main(argv) == 0
    assert np.load(tmp_path / "match" / "match.npz")["labels"].tolist() == ["direct", "mirrored"]


@pytest.mark.parametrize("scale", [1e-50, 1e50])
def test_the_unit_of_length_does_not_matter(tmp_path, scale):
    """From the file through every check to the result, also where the symmetry is read back."""
    x = shapes.blob(2)
    path, found = tmp_path / "x.off", tmp_path / "found"
    save_mesh(x.mesh.moved(x.mesh.verts * scale), path)
    assert main(["symmetry", str(path), "--out", str(found), "--no-picture", *FAST]) == 0
    assert np.load(found / "symmetry.npz")["maps"].tolist() == x.group.maps.tolist()
    summary = json.loads((found / "summary.json").read_text())
    assert summary["warnings"] == []
    argv = ["match", str(path), str(path), "--symmetry", str(found / "symmetry.npz"), "--no-picture", *FAST]
    assert main([*argv, "--out", str(tmp_path / "match")]) == 0
    assert np.load(tmp_path / "match" / "match.npz")["maps"].tolist() == x.group.maps.tolist()


def test_transfer_from_a_reference(files, tmp_path):
    out = tmp_path / "out"
    argv = ["symmetry", str(files / "posed.off"), "--reference", str(files / "rest.off"), "--out", str(out)]
    assert main([*argv, "--no-picture"]) == 0
    assert json.loads((out / "summary.json").read_text())["origin"] == "transfer"
    rest = creature("quadruped", 1000)
    truth = rest.base_group[1]
    found = torch.from_numpy(np.load(out / "symmetry.npz")["maps"][1])
    assert float((rest.mesh.verts[found] - rest.mesh.verts[truth]).norm(dim=1).mean()) / rest.mesh.area**0.5 < 0.01


def test_no_plane_is_a_warning_with_the_residual(files, tmp_path, capsys):
    out = tmp_path / "out"
    assert (
        main(
            ["symmetry", str(files / "posed.off"), "--out", str(out), "--no-picture", *FAST, "--symmetry", "extrinsic"]
        )
        == 0
    )
    assert np.load(out / "symmetry.npz")["maps"].tolist() == [list(range(creature("quadruped", 1000).mesh.n_verts))]
    warnings = json.loads((out / "summary.json").read_text())["warnings"]
    assert any("no mirror plane" in text and "rms" in text for text in warnings)
    assert "torchqm: warning:" in capsys.readouterr().err


def test_from_the_spectrum_alone(files, tmp_path, capsys):
    """The pose has no mirror plane and there is no reference: the truth is its own exact group."""
    out = tmp_path / "out"
    assert main(["symmetry", str(files / "posed.off"), "--out", str(out), "--no-picture"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["origin"] == "detected"
    assert summary["details"]["verdict"] == "symmetric"
    assert "found by: detected" in capsys.readouterr().out
    rest = creature("quadruped", 1000)
    found = torch.from_numpy(np.load(out / "symmetry.npz")["maps"][1])
    gap = (rest.mesh.verts[found] - rest.mesh.verts[rest.base_group[1]]).norm(dim=1)
    assert float(gap.mean()) / rest.mesh.area**0.5 < 0.01


def test_a_whole_group_goes_through_its_file_into_match(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("torchqm.viz.charts.DPI", 60)
    monkeypatch.setattr("torchqm.viz.render.REFINE_BELOW", 0)
    body = creature("ellipsoid", 1000)
    save_mesh(body.mesh, tmp_path / "egg.off")
    egg, out = str(tmp_path / "egg.off"), tmp_path / "out"
    assert main(["symmetry", egg, "--out", str(out), "--symmetry", "extrinsic", "--k-max", "60"]) == 0
    assert "group: C2 x C2 x C2 (8 elements); found by: extrinsic" in capsys.readouterr().out
    assert (out / "symmetry.png").stat().st_size > 10_000
    file = str(out / "symmetry.npz")
    options = ["--symmetry", file, "--symmetry-source", file, "--k-max", "100", "--no-picture"]
    assert main(["match", egg, egg, *options, "--out", str(tmp_path / "match")]) == 0
    maps = np.load(tmp_path / "match" / "match.npz")["maps"]
    same = (maps[:, None] == body.base_group.numpy()).mean(2)
    assert sorted(same.argmax(1).tolist()) == list(range(8))  # each element of the group once
    assert same.max(1).min() > 0.9


def test_picture(files, tmp_path, monkeypatch):
    monkeypatch.setattr("torchqm.viz.charts.DPI", 40)
    monkeypatch.setattr("torchqm.viz.render.REFINE_BELOW", 0)
    assert main(["symmetry", str(files / "blob.off"), "--out", str(tmp_path / "out"), *FAST]) == 0
    assert (tmp_path / "out" / "symmetry.png").read_bytes()[:4] == b"\x89PNG"


def test_bad_input(files, tmp_path, capsys):
    argv = ["symmetry", str(tmp_path / "gone.off"), "--out", str(tmp_path / "out")]
    assert main(argv) == 2
    assert "gone.off: no such file" in capsys.readouterr().err
    argv = [
        "symmetry",
        str(files / "rest.off"),
        "--reference",
        str(tmp_path / "gone.off"),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(argv) == 2
    assert "gone.off: no such file" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
