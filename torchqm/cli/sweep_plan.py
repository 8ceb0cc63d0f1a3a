"""What a sweep runs: a config over seeds, set-ups and a grid of values."""

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchqm.cli.config_errors import nearest_key
from torchqm.cli.console import UserError
from torchqm.cli.yaml_file import read_yaml

__all__ = ["Run", "Sweep", "config_digest", "read_sweep", "runs_of", "word"]

_KEYS = ("config", "seeds", "options", "setups", "grid")


@dataclass(frozen=True)
class Sweep:
    """What is run.

    Args:
        config: YAML file of ``torchqm fit``.
        seeds: each set-up is trained with all of them.
        options: of all runs, such as ``{"model.lr": 1e-3}``.
        setups: name to options of it.
        grid: option to values; every combination is run.
    """

    config: Path
    seeds: Sequence[int] = (0,)
    options: Mapping[str, Any] = field(default_factory=dict)
    setups: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    grid: Mapping[str, Sequence[Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    """One run: its folder's name, what tells it from others, its arguments for ``torchqm fit``, its config's hash."""

    name: str
    labels: Mapping[str, Any]
    seed: int
    arguments: Sequence[str]
    digest: str = ""


def config_digest(path: Path) -> str:
    """A hash of what stands in a YAML file and in the YAML files it names; the same as long as a run means the same."""
    import hashlib

    import yaml

    found, seen = hashlib.sha256(), set[Path]()

    def add(file: Path) -> None:
        if not file.is_file() or file.resolve() in seen:
            return  # if there is none, LightningCLI says so
        seen.add(file.resolve())
        text = file.read_text(errors="replace")
        found.update(text.encode())
        try:
            values = yaml.safe_load(text)
        except yaml.YAMLError:
            return
        for value in values.values() if isinstance(values, dict) else ():
            if isinstance(value, str) and value.endswith((".yaml", ".yml")):
                add(file.parent / value)

    add(path)
    return found.hexdigest()[:16]


def read_sweep(path: Path) -> Sweep:
    """A sweep from a YAML file with the keys ``config`` (from the file's folder on), ``seeds, options, setups, grid``.

    Raises:
        UserError: an unknown key, or a value of the wrong kind.
    """
    given = read_yaml(path)
    if not isinstance(given, dict):
        raise UserError(f"{path}: {_shown(given)} given, expected keys and values, among them 'config'")
    for key in given:
        if key not in _KEYS:
            near = nearest_key(str(key), _KEYS)
            hint = f"the nearest is {near}" if near else f"allowed are {', '.join(_KEYS)}"
            raise UserError(f"{path}: {key}: no such key; {hint}")
    if "config" not in given:
        raise UserError(f"{path}: expected keys and values, among them 'config'")
    wanted: dict[str, _Wanted] = {
        "config": (_is_name, "the name of a YAML file"),
        "seeds": (_is_seeds, "a list of whole numbers from 0 on, at least one and each once"),
        "options": (_is_options, "a mapping of options such as model.lr to values"),
        "setups": (_is_options, "a mapping of names to options"),
        "grid": (_is_options, "a mapping of options to lists of values"),
    }
    _require(path, given, wanted)
    for group, one in (
        ("setups", (_is_options, "a mapping of options such as model.lr to values")),
        ("grid", (_is_values, "a list of at least one value")),
    ):
        own = given.get(group, {})
        _require(path, own, dict.fromkeys(own, one), f"{group}.")
    return Sweep(**{**given, "config": path.parent / given["config"]})


def runs_of(sweep: Sweep, out: Path) -> list[Run]:
    """Every combination; the seed changes last, so that each seed's comparison is whole as early as can be.

    Example:
        >>> plan = Sweep(Path("a.yaml"), (0, 1), grid={"model.k": [20, 40]})
        >>> [run.name for run in runs_of(plan, Path("out"))]
        ['k=20-seed=0', 'k=40-seed=0', 'k=20-seed=1', 'k=40-seed=1']
    """
    runs, digest = [], config_digest(sweep.config)
    setups = sweep.setups or {"": {}}
    for seed, (setup, own), values in itertools.product(
        sweep.seeds, setups.items(), itertools.product(*sweep.grid.values())
    ):
        point = dict(zip(sweep.grid, values, strict=True))
        labels = ({"setup": setup} if setup else {}) | point
        parts = [setup] if setup else []
        parts += [f"{key.split('.')[-1]}={word(value)}" for key, value in point.items()]
        name = "-".join([*parts, f"seed={seed}"]).replace("/", "_")
        options = {**sweep.options, **own, **point, "seed_everything": seed}
        words = [part for key, value in options.items() for part in (f"--{key}", word(value))]
        logger = ("--trainer.logger", "torchqm.learn.logger.RunLogger")
        where = ("--trainer.logger.init_args.save_dir", str(out), "--trainer.logger.init_args.version", name)
        runs.append(Run(name, labels, seed, ["--config", str(sweep.config), *words, *logger, *where], digest))
    if len({run.name for run in runs}) < len(runs):
        raise UserError("sweep: two runs would have the same name; give each set-up and each value once")
    return runs


def word(value: Any) -> str:
    """A value as it stands on a command line.

    Example:
        >>> word("orbit"), word([1, 2]), word(None), word(False)
        ('orbit', '[1, 2]', 'null', 'false')
    """
    return value if isinstance(value, str) else json.dumps(value)


_Wanted = tuple[Callable[[Any], bool], str]


def _require(path: Path, values: Mapping[str, Any], wanted: Mapping[str, _Wanted], group: str = "") -> None:
    for key, (fits, text) in wanted.items():
        if key in values and not fits(values[key]):
            raise UserError(f"{path}: {group}{key}: {_shown(values[key])} given, expected {text}")


def _shown(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and value.strip() != ""


def _is_seeds(value: Any) -> bool:
    numbers = isinstance(value, list) and all(type(seed) is int and 0 <= seed < 2**32 for seed in value)
    return numbers and 0 < len(value) == len(set(value))


def _is_options(value: Any) -> bool:
    return isinstance(value, dict) and all(_is_name(key) for key in value)


def _is_values(value: Any) -> bool:
    return isinstance(value, list) and value != []
