import csv
import json
from pathlib import Path

import pytest
import torch
import yaml

from torchqm.cli.console import UserError
from torchqm.cli.learn import evaluate, fit, learn
from torchqm.learn import MatchModule

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


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(UserError, match=r"no folder of a run; config.yaml is missing"):
        evaluate([str(tmp_path)])
    (tmp_path / "config.yaml").write_text("")
    with pytest.raises(UserError, match="no checkpoint in"):
        evaluate([str(tmp_path)])
