"""The option ``--config`` of commands that need no Lightning: options of the command, or a training's configuration."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torchqm.cli.config_errors import nearest_key
from torchqm.cli.console import UserError
from torchqm.cli.yaml_file import read_yaml

__all__ = ["CONFIG_HELP", "add_config"]

CONFIG_HELP = (
    "YAML with options of this command by name, such as 'k_max: 40'; or the configuration of a training, of which "
    "data.test_root (else data.root, all of it), data.pairs and data.cache_dir are taken, and in a run folder its "
    "network; options that follow change it"
)


def add_config(parser: argparse.ArgumentParser) -> None:
    """The option ``--config FILE``, as :mod:`torchqm.cli.learn` has it: what comes later on the command line wins."""
    parser.add_argument("--config", "-c", type=Path, action=_Config, metavar="FILE", help=CONFIG_HELP)


class _Config(argparse.Action):
    """Gives each value of the file to the action of its option."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        actions = {_key(action): action for action in parser._actions if not isinstance(action, argparse._HelpAction)}
        actions.pop(_key(self))
        for key, value in _options(Path(values)):
            if key not in actions:
                near = nearest_key(key, sorted(actions))
                hint = f"the nearest is {near}" if near else f"allowed are {', '.join(sorted(actions))}"
                raise UserError(f"{values}: {key}: no such key; {hint}")
            if value is not None:
                setattr(namespace, actions[key].dest, _converted(f"{values}: {key}", value, actions[key]))
        setattr(namespace, self.dest, values)


def _key(action: argparse.Action) -> str:
    """``--k-max`` is ``k_max``."""
    name = next((name for name in action.option_strings if name.startswith("--")), action.dest)
    return name.lstrip("-").replace("-", "_")


def _converted(place: str, value: Any, action: argparse.Action) -> Any:
    kind: Any = action.type or str
    wrong = isinstance(value, bool | list | dict) or (kind in (str, Path) and not isinstance(value, str))
    if not wrong:
        try:
            value = kind(value if isinstance(value, str) else str(value))
        except argparse.ArgumentTypeError as error:
            raise UserError(f"{place}: {error}") from error
        except ValueError:
            wrong = True
    if wrong:
        names = {int: "int", str: "a text", Path: "a path"}
        raise UserError(f"{place}: {value!r} given, expected {names.get(kind, 'a number')}")
    if action.choices is not None and value not in action.choices:
        raise UserError(f"{place}: {value!r} given, allowed are {', '.join(map(str, action.choices))}")
    return value


def _options(path: Path) -> Iterator[tuple[str, Any]]:
    """The options that a file gives."""
    values = _read(path)
    if "data" not in values:
        yield from values.items()
        return
    data = values["data"]
    if isinstance(data, str):  # a piece of its own, from the folder of this one on
        data = _read(path.parent / data)
    if not isinstance(data, dict):
        raise UserError(f"{path}: data: expected keys and values, or a YAML file of them")
    yield "root", data.get("test_root") or data.get("root")
    yield "pairs", data.get("pairs")
    yield "cache", data.get("cache_dir")
    if (path.parent / "checkpoints").is_dir():
        yield "checkpoint", str(path.parent)


def _read(path: Path) -> dict[str, Any]:
    values = read_yaml(path)
    if not isinstance(values, dict):
        raise UserError(f"{path}: expected keys and values")
    return {str(key): value for key, value in values.items()}
