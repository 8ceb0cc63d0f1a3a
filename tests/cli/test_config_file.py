import argparse
from pathlib import Path

import pytest
import yaml

from torchqm.cli.config_file import add_config
from torchqm.cli.console import UserError
from torchqm.cli.main import build_parser

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def given(tmp_path, values, *more):
    path = tmp_path / "a.yaml"
    path.write_text(values if isinstance(values, str) else yaml.safe_dump(values))
    return build_parser().parse_args(["predict", "--config", str(path), *more])


def test_values_are_those_of_the_command_line(tmp_path):
    found = given(tmp_path, {"k_max": 40, "time": 1, "out": "x", "cache": "y", "refinement": "icp", "samples": "20"})
    words = ["--k-max", "40", "--time", "1", "--out", "x", "--cache", "y", "--refinement", "icp", "--samples", "20"]
    wanted = build_parser().parse_args(["predict", *words])
    found.config = None
    assert vars(found) == vars(wanted)


def test_what_comes_later_wins(tmp_path):
    assert given(tmp_path, {"root": "a", "k": 3}, "--k", "4").k == 4
    path = str(tmp_path / "a.yaml")
    assert build_parser().parse_args(["predict", "b", "--k", "4", "--config", path]).k == 3
    assert build_parser().parse_args(["predict", "--config", path]).root == "a"
    assert build_parser().parse_args(["predict", "--config", path, "b"]).root == "b"


def test_a_training_names_its_shapes_and_its_network(tmp_path):
    experiment = CONFIGS / "experiment" / "quick.yaml"
    found = build_parser().parse_args(["predict", "--config", str(experiment)])
    data = yaml.safe_load((CONFIGS / "data" / "creatures.yaml").read_text())
    assert (found.root, found.pairs, found.checkpoint) == (data["test_root"], data["pairs"], None)
    values = {"model": {"k": 5}, "data": {"root": "a", "test_root": None, "cache_dir": "c"}}
    (tmp_path / "checkpoints").mkdir()
    found = given(tmp_path, values)
    assert (found.root, found.pairs, found.cache, found.k) == ("a", "within-class", Path("c"), None)
    assert found.checkpoint == str(tmp_path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kmax": 4}, "kmax: no such key; the nearest is k_max"),
        ({"config": "b"}, "config: no such key"),
        ({"zzzz": 4}, "zzzz: no such key; allowed are cache, checkpoint"),
        ({"k": "ten"}, "k: 'ten' given, expected int"),
        ({"k": 2.5}, "k: 2.5 given, expected int"),
        ({"k": True}, "k: True given, expected int"),
        ({"time": "soon"}, "time: 'soon' given, expected a number"),
        ({"time": float("nan")}, "time: nan is no finite number"),
        ({"out": 3}, "out: 3 given, expected a path"),
        ({"pairs": ["a"]}, "pairs: \\['a'\\] given, expected a text"),
        ({"descriptor": "shot"}, "descriptor: 'shot' given, allowed are wks, hks"),
        ({"data": 3}, "data: expected keys and values"),
        ({"data": "none.yaml"}, "none.yaml: not readable as YAML \\(No such file"),
        ("a: [", "a.yaml: not readable as YAML"),
        ("- a", "a.yaml: expected keys and values"),
    ],
)
def test_what_is_wrong_is_named_with_its_file(values, message, tmp_path):
    with pytest.raises(UserError, match=message) as error:
        given(tmp_path, values)
    assert str(tmp_path) in str(error.value)


def test_a_file_that_is_not_there_is_named():
    parser = argparse.ArgumentParser()
    add_config(parser)
    with pytest.raises(UserError, match=r"none\.yaml: not readable as YAML \(No such file or directory\)"):
        parser.parse_args(["--config", "none.yaml"])
