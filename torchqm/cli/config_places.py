"""Where an option of a config stands: on the command line, or in one of its YAML files."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["Source", "given_options", "on_one_line", "place_of", "sources_of"]

_ENDINGS = (".yaml", ".yml", ".json")


@dataclass(frozen=True)
class Source:
    """What one argument gives, or one file.

    Args:
        values: by key, nested or with dots.
        place: the path of a file, the option that has a whole config as text; empty: the option of the key itself.
        fault: why it cannot be read; empty if it can.
    """

    values: dict[str, Any]
    place: str = ""
    fault: str = ""


def sources_of(args: Sequence[str]) -> list[Source]:
    """What the arguments give, in their order: of a key that several have, the last one counts.

    Args:
        args: ``--config FILE``, ``--config '{model: {lr: 3}}'``, ``--model FILE``, ``--model.lr 3`` and so on. A file
            that is named in another comes right after it.

    Example:
        >>> [source.values for source in sources_of(["fit", "--trainer.devices", "{}", "--model.lr=3"])]
        [{'trainer.devices': {}}, {'model.lr': 3}]
    """
    return list(_sources(args))


def place_of(key: str, sources: Sequence[Source]) -> str:
    """The key, after the file that has it, the last of them; on the command line with its dashes.

    What belongs to an object, such as ``trainer.callbacks.init_args.mode``, is where the object is.

    Example:
        >>> place_of("model.lr", sources_of(["--model.lr", "3"])), place_of("model.lr", [])
        ('--model.lr', 'model.lr')
    """
    whole = key
    while True:
        if holders := [source for source in sources if _has(source.values, key)]:
            place = holders[-1].place
            return f"{place}: {whole}" if place else f"--{whole}"
        if key.count(".") < 2:  # a group is in a file that need not have this key of it
            return whole
        key = key.rpartition(".")[0]


def given_options(sources: Sequence[Source]) -> list[tuple[str, Any]]:
    """The options that somebody gave, each with its value; of a key that is given again the last.

    Of a list of objects each has its options under the same key, its class before its arguments.

    Example:
        >>> given_options(sources_of(["--trainer.devices", "{}", "--model.lr=3"]))
        [('trainer.devices', {}), ('model.lr', 3)]
        >>> given_options(sources_of(["--trainer.callbacks", "[{class_path: a.B, init_args: {mode: low}}]"]))
        [('trainer.callbacks.class_path', 'a.B'), ('trainer.callbacks.init_args.mode', 'low')]
    """
    found: list[tuple[str, Any]] = []
    for source in sources:
        new = list(_flat("", source.values)) if source.values else []
        keys = {key for key, _ in new}
        found = [*((key, value) for key, value in found if key not in keys), *new]
    return found


def on_one_line(text: str) -> str:
    """The words of a text, with one space between them."""
    return " ".join(text.split())


def _flat(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        for name, part in sorted(value.items(), key=lambda each: each[0] != "class_path"):
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


def _sources(args: Sequence[str]) -> Iterator[Source]:
    for option, value in zip(args, [*args[1:], ""], strict=False):
        name, equals, joined = option.partition("=")
        text = joined if equals else value
        if name in ("--config", "-c"):
            yield from _file(Path(text), "") if _is_file(Path(text)) else _inline(name, text)
        elif re.fullmatch(r"--\w+", name) and text.endswith(_ENDINGS) and _is_file(Path(text)):
            yield from _file(Path(text), name.removeprefix("--"))
        elif name.startswith("--"):
            yield Source({name.removeprefix("--"): _read(text)})


def _file(path: Path, group: str, above: tuple[Path, ...] = ()) -> Iterator[Source]:
    import yaml

    try:
        values = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        yield Source({}, str(path), on_one_line(str(error)))
        return
    if group:
        yield Source({group: values}, str(path))
    else:
        yield Source(values if isinstance(values, dict) else {}, str(path))
    yield from _named(values, path.parent, (*above, path.resolve()))


def _inline(option: str, text: str) -> Iterator[Source]:
    """A whole config as the value of an option; the parser says what is wrong with any other text."""
    values = _read(text)
    if not isinstance(values, dict):
        yield Source({"config": text})
        return
    yield Source(values, option)
    yield from _named(values, Path(), ())


def _named(values: Any, folder: Path, above: tuple[Path, ...]) -> Iterator[Source]:
    """The files that a config names as its groups."""
    for group, name in values.items() if isinstance(values, dict) else ():
        is_file = isinstance(name, str) and name.endswith(_ENDINGS) and _is_file(folder / name)
        if is_file and (folder / name).resolve() not in above:  # a file that names itself would have no end
            yield from _file(folder / name, group, above)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a text that is too long for a path is none
        return False


def _read(text: str) -> Any:
    """The value that a text is in YAML; if it is none, the text as it was written."""
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text
