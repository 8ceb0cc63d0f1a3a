"""What benchmarks/learning.py and transfer.py keep between calls is not taken for what another config made."""

import importlib
import json
from pathlib import Path

import pytest

import torchqm.data.datamodule as datamodule
from torchqm.data import open_shapes

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
ROOT = "synthetic:kinds=ellipsoid;poses=2;verts=500;triangulation=shared"


@pytest.fixture
def load(monkeypatch):
    monkeypatch.setattr(datamodule, "open_shapes", datamodule.open_shapes)  # learning.py puts another in its place
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module


@pytest.fixture
def config(tmp_path):
    (tmp_path / "model.yaml").write_text("k: 40")
    (tmp_path / "data.yaml").write_text(f"root: '{ROOT}'")
    path = tmp_path / "config.yaml"
    path.write_text("model: model.yaml\ndata: data.yaml")
    return path


def test_rows_of_another_config_root_or_version_are_made_again_and_it_is_said(
    load, config, tmp_path, capsys, monkeypatch
):
    kept, made, path = load("kept"), [], tmp_path / "rows.json"

    def rows(root, **more):
        about = kept.made_of(config, root, **more)
        return kept.kept_rows(path, about, lambda: [{"number": made.append(1) or len(made)}])

    def said(*words):
        text = capsys.readouterr().out
        return text.startswith(f"{path}: made with another {', '.join(words)};") if words else text == ""

    assert rows("a", pairs=[("x", "y")]) == [{"number": 1}]
    assert rows("a", pairs=[("x", "y")]) == [{"number": 1}]
    assert said()
    (tmp_path / "model.yaml").write_text("k: 60")  # a file that the config names
    assert rows("a", pairs=[("x", "y")]) == [{"number": 2}]
    assert said("config")
    assert rows("b", pairs=[("x", "z")]) == [{"number": 3}]
    assert said("pairs", "root")
    monkeypatch.setattr(kept, "__version__", "9.9.9")
    assert rows("b", pairs=[("x", "z")]) == [{"number": 4}]
    assert said("torchqm")
    path.write_text("{")
    assert rows("b", pairs=[("x", "z")]) == [{"number": 5}]
    assert "not readable" in capsys.readouterr().out
    assert rows("b", pairs=[("x", "z")]) == [{"number": 5}]


def test_other_meshes_under_the_same_names_are_other_data(load, tmp_path):
    kept = load("kept")
    cube = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
    for name in ("a0", "a1"):
        (tmp_path / f"{name}.off").write_text(cube)
    digests = [kept.data_digest(open_shapes(tmp_path), [("a0", "a1")])]
    digests.append(kept.data_digest(open_shapes(tmp_path), [("a0", "a1")]))
    (tmp_path / "a1.off").write_text(cube.replace("0 0 1", "0 0 2"))
    digests.append(kept.data_digest(open_shapes(tmp_path), [("a0", "a1")]))
    assert digests[0] == digests[1] != digests[2]
    names = [f"ellipsoid-0-pose{pose}" for pose in (0, 1)]
    one, two = (kept.data_digest(open_shapes(root), [names]) for root in (ROOT, ROOT.replace("500", "600")))
    assert one != two


def test_a_training_of_another_config_is_refused(load, config, tmp_path, monkeypatch):
    learning, ran = load("learning"), []
    monkeypatch.setattr(learning, "CONFIG", config)
    monkeypatch.setattr(learning, "fit", ran.append)
    monkeypatch.setattr(learning, "load_net", lambda folder: folder)
    out = tmp_path / "out"
    folder = learning.trained("quotient", 0, out, [])
    assert learning.trained("quotient", 0, out, []) == folder == out / "runs" / "quotient" / "seed0"
    assert len(ran) == 1
    with pytest.raises(
        SystemExit, match=r"seed0: has a training with another arguments \(made_of.json\); give another"
    ):
        learning.trained("quotient", 0, out, ["--model.lr", "1"])
    (tmp_path / "model.yaml").write_text("k: 60")
    with pytest.raises(SystemExit, match=r"seed0: has a training with another config \(made_of.json\)"):
        learning.trained("quotient", 0, out, [])
    (folder / "made_of.json").unlink()
    with pytest.raises(SystemExit, match="everything, for all one can tell"):
        learning.trained("quotient", 0, out, [])
    assert len(ran) == 1


def test_fine_tuning_is_torchqm_fit_and_is_refused_where_it_was_of_other_data(load, tmp_path, monkeypatch):
    transfer, ran = load("transfer"), []
    root = "synthetic:kinds=ellipsoid;bodies=2;poses=2;verts=500;triangulation=shared"

    def finetuned(root):
        pairs = transfer.Pairs(root, "within-class+unordered", tmp_path / "cache", tmp_path / "cache")
        return transfer.finetuned("builtin", pairs, "ellipsoid-1", 1, 1e-3, tmp_path)

    def fit(args):
        ran.append(args)
        return learn_fit(args)

    learn_fit = transfer.fit
    monkeypatch.setattr(transfer, "fit", fit)
    built_in, tuned = transfer.load_net("builtin"), finetuned(root)
    assert transfer.digest(finetuned(root)) == transfer.digest(tuned) != transfer.digest(built_in)
    assert len(ran) == 1
    given = dict(zip(ran[0][::2], ran[0][1::2], strict=True))
    assert given["--model.start"] == "builtin"
    assert json.loads(given["--data.classes"]) == ["ellipsoid-1"]
    with pytest.raises(SystemExit, match="has a training with another data, root"):
        finetuned(root.replace("500", "600"))
