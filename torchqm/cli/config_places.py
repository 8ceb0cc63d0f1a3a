"""Where an option of a config stands: on the command line, or in one of its YAML files."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

__all__ = ["Files", "files_of", "given_options", "on_one_line", "place_of"]

Files = Sequence[tuple[Path, dict[str, Any], str]]
"""YAML files: the path, what is in it by key, and why it cannot be read (empty if it can)."""

_ENDINGS = (".yaml", ".yml", ".json")


def files_of(args: Sequence[str]) -> Files:
    """Each YAML file among the arguments and those that they name: its values, below their group, and its fault.

    Args:
        args: ``--config FILE``, ``--model FILE``, ``--model.lr 3`` and so on.
    """
    return list(_files(args))


def place_of(key: str, args: Sequence[str], files: Files) -> str:
    """The key, after the file that has it; on the command line, which comes last, with its dashes.

    What belongs to an object, such as ``trainer.callbacks.init_args.mode``, is where the object is.

    Example:
        >>> place_of("model.lr", ["--model.lr", "3"], []), place_of("model.lr", [], [])
        ('--model.lr', 'model.lr')
    """
    whole = key
    while True:
        if any(re.fullmatch(rf"--{re.escape(key)}(=.*)?", arg, re.DOTALL) for arg in args):
            return f"--{whole}"
        if holders := [path for path, values, _ in files if _has(values, key)]:
            return f"{holders[-1]}: {whole}"
        if key.count(".") < 2:  # a group is in a file that need not have this key of it
            return whole
        key = key.rpartition(".")[0]


def given_options(args: Sequence[str], files: Files) -> list[tuple[str, Any]]:
    """The options that somebody gave, each with its value; of a key that is given again the last.

    Of a list of objects each has its options under the same key.

    Example:
        >>> given_options(["--trainer.devices", "{}", "--model.lr=3"], [])
        [('trainer.devices', {}), ('model.lr', 3)]
        >>> given_options(["--trainer.callbacks", "[{class_path: a.B, init_args: {mode: low}}]"], [])
        [('trainer.callbacks.class_path', 'a.B'), ('trainer.callbacks.init_args.mode', 'low')]
    """
    import yaml

    sources = [values for _, values, _ in files]
    for option, value in zip(args, [*args[1:], ""], strict=False):
        name, equals, joined = option.partition("=")
        if not name.startswith("--"):
            continue
        text = joined if equals else value
        try:
            sources.append({name.removeprefix("--"): yaml.safe_load(text)})
        except yaml.YAMLError:
            sources.append({name.removeprefix("--"): text})
    found: list[tuple[str, Any]] = []
    for values in sources:
        new = list(_flat("", values))
        keys = {key for key, _ in new}
        found = [*((key, value) for key, value in found if key not in keys), *new]
    return found


def on_one_line(text: str) -> str:
    """The words of a text, with one space between them."""
    return " ".join(text.split())


def _flat(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        for name, part in value.items():
            yield from _flat(f"{key}.{name}" if key else str(name), part)
    elif isinstance(value, list) and any(isinstance(part, dict) for part in value):
        for part in value:
            yield from _flat(key, part)
    else:
        yield key, value


def _has(values: Any, key: str) -> bool:
    if isinstance(values, dict) and key in values:
        return True
    first, _, rest = key.partition(".")
    return isinstance(values, dict) and bool(rest) and _has(values.get(first), rest)


def _files(args: Sequence[str]) -> Iterator[tuple[Path, dict[str, Any], str]]:
    for option, value in zip(args, [*args[1:], ""], strict=False):
        name, _, joined = option.partition("=")
        if name in ("--config", "-c"):
            yield from _file(Path(joined or value), "")
        elif re.fullmatch(r"--\w+", name) and (joined or value).endswith(_ENDINGS):
            yield from _file(Path(joined or value), name.removeprefix("--"))


def _file(path: Path, group: str, above: tuple[Path, ...] = ()) -> Iterator[tuple[Path, dict[str, Any], str]]:
    import yaml

    if not path.is_file() or path.resolve() in above:  # a file that names itself would have no end
        return
    try:
        values = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        yield path, {}, on_one_line(str(error))
        return
    yield path, {group: values} if group else values, ""
    if isinstance(values, dict):
        for key, value in values.items():
            if isinstance(value, str) and value.endswith(_ENDINGS):
                yield from _file(path.parent / value, key, (*above, path.resolve()))
