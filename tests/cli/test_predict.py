import json

import numpy as np
import pytest
import torch
import yaml
from references import shapes

from torchqm.cli.main import main
from torchqm.geometry import save_mesh
from torchqm.learn import MatchNet, NetOptions, save_net

FAST = ["--k-max", "40", "--samples", "300"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two equal shapes, a mesh that is none, and a network."""
    folder = tmp_path_factory.mktemp("set")
    torch.manual_seed(0)
    save_net(MatchNet(NetOptions(k=20, channels=16, width=16)), folder / "net.safetensors")
    (folder / "set").mkdir()
    for name in ("a0", "a1"):
        save_mesh(shapes.blob(2).mesh, folder / "set" / f"{name}.off")
    (folder / "pairs.txt").write_text("a0 a1\na1 a0\n")
    return folder


def predict(folder, out, *more, net="net.safetensors"):
    argv = ["predict", str(folder / "set"), "--checkpoint", str(folder / net), "--out", str(out), *FAST]
    return main([*argv, "--pairs", str(folder / "pairs.txt"), *more])


def test_what_is_there_is_not_made_again_and_what_is_missing_is(folder, tmp_path, capsys):
    assert predict(folder, tmp_path) == 0
    first, second = tmp_path / "a0+a1.npz", tmp_path / "a1+a0.npz"
    with np.load(first, allow_pickle=False) as kept:
        assert kept["labels"].tolist() == ["direct", "mirrored"]
        assert (kept["maps"][0] == np.arange(642)).mean() > 0.95
    assert "2 of 2 pairs are in" in capsys.readouterr().out
    content, when = second.read_bytes(), first.stat().st_mtime_ns
    second.unlink()
    assert predict(folder, tmp_path) == 0
    assert "2 pairs, 1 of them are there" in capsys.readouterr().out
    assert first.stat().st_mtime_ns == when
    with np.load(second) as kept:
        second.write_bytes(content)
        with np.load(second) as before:
            assert kept["maps"].tolist() == before["maps"].tolist()


def test_maps_of_another_network_are_not_mixed_with_these(folder, tmp_path, capsys):
    (tmp_path / "predict.json").write_text(json.dumps({"descriptors": "LearnedDescriptors(0)"}))
    assert predict(folder, tmp_path) == 2
    assert "holds maps of other descriptors, root, parameters, version" in capsys.readouterr().err
    (tmp_path / "predict.json").write_text("{")
    assert predict(folder, tmp_path) == 2
    assert "predict.json: cannot be used" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["predict.json"]


def test_a_pair_that_fails_is_named_and_the_others_are_made(folder, tmp_path, capsys, monkeypatch):
    from torchqm.learn import LearnedDescriptors
    from torchqm.matching import MatchError

    own, calls = LearnedDescriptors.__call__, []

    def failing(self, shape):
        calls.append(shape.mesh.name)
        if len(calls) == 1:
            raise MatchError("too\nodd")
        return own(self, shape)

    monkeypatch.setattr(LearnedDescriptors, "__call__", failing)
    assert predict(folder, tmp_path) == 1
    out, err = capsys.readouterr()
    assert "torchqm: warning: a0 → a1: too odd\n" in err
    assert "1 of 2 pairs are in" in out
    assert {path.name for path in tmp_path.iterdir()} == {"predict.json", "a1+a0.npz"}


def test_wrong_input_is_one_line(folder, tmp_path, capsys):
    for more, net, message in (
        ((), "no.ckpt", "no.ckpt: no such file"),
        (("--checkpoint", "https://x.org/a.ckpt"), "no.ckpt", "https://x.org/a.ckpt: a URL"),
        (("--pairs", "some"), "net.safetensors", "no such file, and no known word"),
        (("--k-max", "3"), "net.safetensors", "k_max=3"),
    ):
        assert predict(folder, tmp_path / "out", *more, net=net) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_file_gives_the_options_and_what_follows_changes_them(folder, tmp_path, capsys):
    values = {"root": str(folder / "set"), "checkpoint": str(folder / "net.safetensors"), "k_max": 60, "samples": 300}
    values |= {"pairs": str(folder / "pairs.txt"), "out": str(tmp_path / "out"), "descriptor": None}
    path = tmp_path / "predict.yaml"
    path.write_text(yaml.safe_dump(values))
    assert main(["predict", "--config", str(path), "--k-max", "40"]) == 0
    whole = json.loads((tmp_path / "out" / "predict.json").read_text())
    assert whole["parameters"]["k_max"] == 40
    assert predict(folder, tmp_path / "out") == 0  # the same, in words
    assert "2 pairs, 2 of them are there" in capsys.readouterr().out


def test_what_is_needed_and_not_given_is_named(folder, tmp_path, capsys):
    assert main(["predict", "--checkpoint", "builtin"]) == 2
    assert "error: ROOT: not given, but needed\n" in capsys.readouterr().err
    (tmp_path / "a.yaml").write_text("root: somewhere")
    assert main(["predict", "-c", str(tmp_path / "a.yaml")]) == 2
    assert "error: --checkpoint: not given, but needed\n" in capsys.readouterr().err
