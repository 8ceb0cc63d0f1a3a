import json

import pytest
import torch
import yaml
from safetensors import safe_open

from torchqm.cli.main import main
from torchqm.learn import MatchNet, NetOptions, load_net, save_net
from torchqm.learn.files import digest


@pytest.fixture
def net():
    torch.manual_seed(0)
    return MatchNet(NetOptions(k=12, signature=8, channels=6, width=8))


@pytest.fixture
def run_folder(tmp_path, net):
    """What a training leaves, with only what is read of it."""
    folder = tmp_path / "run"
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump({"seed_everything": 4, "model": {"k": 12}}))
    (folder / "versions.json").write_text('{"torchqm": "0.1"}')
    options = {"k": 12, "signature": 8, "channels": 6, "width": 8, "lr": 1e-3}
    state = {f"net.{name}": value for name, value in net.state_dict().items()}
    torch.save({"state_dict": state, "hyper_parameters": options}, folder / "checkpoints" / "best-epoch=3.ckpt")
    return folder


def test_a_run_becomes_one_file_that_says_how_it_was_trained(run_folder, net, tmp_path, capsys):
    out = tmp_path / "net.safetensors"
    assert main(["export", str(run_folder), "--out", str(out)]) == 0
    assert digest(load_net(out)) == digest(net)
    with safe_open(out, "pt") as file:
        about = json.loads(file.metadata()["torchqm"])["about"]
    assert about == {
        "checkpoint": "best-epoch=3.ckpt",
        "config": {"seed_everything": 4, "model": {"k": 12}},
        "versions": {"torchqm": "0.1"},
    }
    printed = capsys.readouterr().out
    assert digest(net) in printed
    assert f"({out.stat().st_size} bytes)" in printed
    again = tmp_path / "again.safetensors"
    assert main(["export", str(run_folder), "--out", str(again)]) == 0
    assert again.read_bytes() == out.read_bytes()
    assert capsys.readouterr().err == ""
    other = run_folder / "checkpoints" / "best-epoch=4.ckpt"
    other.write_bytes(other.with_name("best-epoch=3.ckpt").read_bytes())
    assert main(["export", str(run_folder), "--out", str(again)]) == 0
    (line,) = capsys.readouterr().err.splitlines()  # nothing says which of them scored best
    assert line.startswith(f"torchqm: warning: {other}: taken for its name")


def test_what_cannot_be_exported_is_one_line(run_folder, net, tmp_path, capsys):
    (run_folder / "config.yaml").write_text("a: [")
    for source, out, message in (
        (run_folder, "net.safetensors", "config.yaml: cannot be read"),
        (tmp_path / "none", "net.safetensors", "none: no such file or run folder"),
        (save_net(net, tmp_path / "own.safetensors"), "net.bin", "net.bin: a trained network is written to"),
        (tmp_path / "own.safetensors", "no/net.safetensors", "net.safetensors: cannot be written"),
    ):
        assert main(["export", str(source), "--out", str(tmp_path / out)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("torchqm: error:")
        assert message in error
        assert error.count("\n") == 1
    assert not list(tmp_path.glob("net.*"))
