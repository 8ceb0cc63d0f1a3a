from pathlib import Path

import pytest

from torchqm.cli.console import UserError
from torchqm.cli.learn import learn
from torchqm.cli.sweep_plan import Sweep, read_sweep, runs_of

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_all_combinations_with_what_they_have_in_common():
    plan = Sweep(
        Path("a.yaml"),
        seeds=(3, 4),
        options={"model.lr": 0.1, "model.setup": "quotient"},
        setups={"full": {"model.setup": "functional_map"}, "half": {}},
        grid={"data.swapped": [0.0, 0.5], "model.inputs": [["wks", "xyz"]]},
    )
    runs = runs_of(plan, Path("out"))
    assert len({run.name for run in runs}) == len(runs) == 8
    assert [run.seed for run in runs] == [3] * 4 + [4] * 4
    run = runs[1]
    assert run.name == 'full-swapped=0.5-inputs=["wks", "xyz"]-seed=3'
    assert run.labels == {"setup": "full", "data.swapped": 0.5, "model.inputs": ["wks", "xyz"]}
    given = dict(zip(run.arguments[::2], run.arguments[1::2], strict=True))
    assert given["--config"] == "a.yaml"
    assert given["--model.setup"] == "functional_map"
    assert given["--model.lr"] == "0.1"
    assert given["--model.inputs"] == '["wks", "xyz"]'
    assert given["--seed_everything"] == "3"
    assert given["--trainer.logger.init_args.version"] == run.name
    with pytest.raises(UserError, match="two runs would have the same name"):
        runs_of(Sweep(Path("a.yaml"), (1, 1)), Path("out"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("config: a.yaml\nseed: [1]\n", r"s.yaml: seed: no such key; the nearest is seeds"),
        ("config: a.yaml\nzzzz: 1\n", r"s.yaml: zzzz: no such key; allowed are config, seeds"),
        ("config: a.yaml\nseeds: 3\n", r"s.yaml: seeds: 3 given, expected a list"),
        ("config: a.yaml\ngrid: {model.k: 3}\n", r"s.yaml: grid.model.k: 3 given, expected a list"),
        ("config: a.yaml\nsetups: {a: [1]}\n", r"s.yaml: setups.a: \[1\] given, expected a mapping"),
        ("config: 3\n", r"s.yaml: config: 3 given, expected the name of a YAML file"),
        ("config: [a.yaml]\n", r"s.yaml: config: \['a.yaml'\] given, expected the name of a YAML file"),
        ("config:\n", r"s.yaml: config: None given, expected the name of a YAML file"),
        ("confg: a.yaml\n", r"s.yaml: confg: no such key; the nearest is config"),
        ("config: a.yaml\nseeds: [0, one]\n", r"s.yaml: seeds: \[0, 'one'\] given, expected a list of whole numbers"),
        ("config: a.yaml\nseeds: [true]\n", r"s.yaml: seeds: \[True\] given, expected a list of whole numbers"),
        ("config: a.yaml\nseeds: [-1]\n", r"s.yaml: seeds: \[-1\] given, expected .* from 0 on"),
        ("config: a.yaml\nseeds: [1, 1]\n", r"s.yaml: seeds: \[1, 1\] given, expected .* each once"),
        ("config: a.yaml\nseeds: []\n", r"s.yaml: seeds: \[\] given, expected .* at least one"),
        ("config: a.yaml\noptions: [model.lr]\n", r"s.yaml: options: \['model.lr'\] given, expected a mapping"),
        ("config: a.yaml\noptions: {3: 4}\n", r"s.yaml: options: \{3: 4\} given, expected a mapping of options"),
        ("config: a.yaml\nsetups: plain\n", r"s.yaml: setups: 'plain' given, expected a mapping of names"),
        ("config: a.yaml\ngrid: {model.k: []}\n", r"s.yaml: grid.model.k: \[\] given, expected a list of at least one"),
        ("3\n", "s.yaml: 3 given, expected keys and values, among them 'config'"),
        ("seeds: [1]\n", "s.yaml: expected keys and values, among them 'config'"),
        ("[1\n", "s.yaml: not readable as YAML"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(text, message, tmp_path):
    (tmp_path / "s.yaml").write_text(text)
    with pytest.raises(UserError, match=message):
        read_sweep(tmp_path / "s.yaml")


@pytest.mark.parametrize("path", sorted((CONFIGS / "sweep").glob("*.yaml")), ids=lambda path: path.name)
def test_every_sweep_that_is_shipped_is_parsed(path, tmp_path):
    for run in runs_of(read_sweep(path), tmp_path)[:4]:
        built = learn(run.arguments, run=False)
        assert built.config.seed_everything == run.seed
        assert built.trainer.loggers[0].version == run.name
    assert not list(tmp_path.iterdir())
