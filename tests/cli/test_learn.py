import csv
import json
from pathlib import Path

import pytest
import torch
import yaml

from torchqm.cli.console import UserError
from torchqm.cli.learn import evaluate, fit, learn
from torchqm.learn import MatchModule, load_net

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
FILES = sorted(path.relative_to(CONFIGS).as_posix() for path in CONFIGS.rglob("*.yaml") if path.parent.name != "sweep")
TINY = [
    *("--data.root", "synthetic:kinds=ellipsoid;verts=500;triangulation=shared", "--data.shares", "[1,0,0]"),
    *(
        "--data.pairs",
        "unordered",
        "--data.test_root",
        "synthetic:kinds=ellipsoid;poses=2;verts=500;triangulation=shared",
    ),
    *("--data.whole_classes", "false", "--data.batch_size", "2"),
    *("--model.k", "10", "--model.channels", "8", "--model.width", "8", "--model.signature", "8"),
    *("--checkpoint.monitor", "null", "--trainer.max_epochs", "1", "--trainer.num_sanity_val_steps", "0"),
]


@pytest.fixture(scope="module")
def parser():
    return learn(["--data.root", "synthetic:"], run=False).parser


@pytest.mark.parametrize("name", FILES)
def test_every_config_is_parsed(name, parser):
    group = name.split("/")[0]
    own = ["--config", str(CONFIGS / name)] if group == "experiment" else [f"--{group}", str(CONFIGS / name)]
    root = [] if group in ("experiment", "data") else ["--data.root", "synthetic:"]
    found = parser.parse_args([*own, *root])
    values = yaml.safe_load((CONFIGS / name).read_text())
    if group == "experiment":
        assert found.seed_everything == values["seed_everything"]
        assert found.data.root == yaml.safe_load((CONFIGS / "experiment" / values["data"]).read_text())["root"]
    else:
        assert {key: found[group][key] for key in values if key != "logger"} == {
            key: value for key, value in values.items() if key != "logger"
        }
    assert found.data.k == found.model.k
    assert ("gradients" in found.data["keys"]) == (found.model.network == "diffusion")


def test_configs_of_tosca_have_classes_to_tune_on_only_and_no_root():
    for path in sorted((CONFIGS / "data").glob("tosca*.yaml")):
        values = yaml.safe_load(path.read_text())
        assert set(values["classes"]) <= {"cat", "centaur", "david", "wolf"}, path
        assert values["root"] == "give --data.root ROOT"  # the error of a run without one says so


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("--model.lrr", "--model.lrr: no such option; the nearest is --model.lr"),
        ("--model.lr", "'fast' given, expected"),
    ],
)
def test_wrong_keys_and_types_are_named(argument, message):
    with pytest.raises(UserError, match=message):
        learn(["--data.root", "synthetic:", argument, "fast"], run=False)


def test_a_run_folder_holds_everything_and_is_tested_from_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fit(["--config", str(CONFIGS / "experiment" / "quick.yaml"), *TINY])
    folder = tmp_path / "runs" / "version_0"
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["model"]["channels"] == 8
    assert config["seed_everything"] == 0
    assert json.loads((folder / "versions.json").read_text())["torch"] == torch.__version__
    with (folder / "metrics.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert float(row["train_loss"]) > 0
    module = MatchModule.load_from_checkpoint(folder / "checkpoints" / "last.ckpt", weights_only=True)
    assert module.hparams["channels"] == 8
    tested = evaluate([str(folder)])
    assert set(tested.trainer.callback_metrics) >= {"test_loss", "test_orbit_error", "test_flipped_map"}
    assert all(torch.equal(a, b) for a, b in zip(module.parameters(), tested.model.parameters(), strict=True))
    own = folder / "test" / "version_0"
    assert yaml.safe_load((own / "config.yaml").read_text())["model"]["channels"] == 8
    assert [path.name for path in folder.parent.iterdir()] == ["version_0"]


@pytest.mark.usefixtures("plain_curves")
def test_fine_tuning_is_a_training_that_begins_with_given_weights(tmp_path, monkeypatch):
    """As configs/experiment/finetune.yaml has it, on creatures; with no learning rate the weights stay those given."""
    monkeypatch.chdir(tmp_path)
    given = ["--config", str(CONFIGS / "experiment" / "finetune.yaml"), "--trainer.max_epochs", "1"]
    root = "synthetic:kinds=ellipsoid;bodies=2;poses=2;verts=500;triangulation=shared"
    data = ["--data.root", root, "--data.classes", "[ellipsoid-1]"]
    with pytest.raises(UserError, match=r"^give --data.root ROOT: no such folder$"):
        fit(given)
    for start, message in {
        str(tmp_path / "none.safetensors"): "start: .*none.safetensors: no such file or run folder",
        str(CONFIGS / "README.md"): r"start: .*README.md: a trained network is a .safetensors or a .ckpt file",
    }.items():
        with pytest.raises(UserError, match=message):
            fit([*given, *data, "--model.start", start])
    with pytest.raises(UserError, match="start: builtin holds another architecture: width is 64 here and 128 there"):
        fit([*given, *data, "--model.width", "64"])
    done = fit([*given, *data, "--model.lr", "0"])
    assert {name for pair in done.datamodule.parts["train"].pairs for name in pair} == {
        "ellipsoid-1-pose0", "ellipsoid-1-pose1"
    }  # fmt: skip
    folder = Path(done.trainer.log_dir)
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["last.ckpt"]
    tuned, built_in = load_net(folder), load_net("builtin")
    assert all(torch.equal(a, b) for a, b in zip(tuned.parameters(), built_in.parameters(), strict=True))
    again = fit([*given, *data, "--model.start", str(folder)])
    assert not all(torch.equal(a, b) for a, b in zip(again.model.net.parameters(), built_in.parameters(), strict=True))


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(UserError, match=r"no folder of a run; config.yaml is missing"):
        evaluate([str(tmp_path)])
    (tmp_path / "config.yaml").write_text("")
    with pytest.raises(UserError, match="no checkpoint in"):
        evaluate([str(tmp_path)])
