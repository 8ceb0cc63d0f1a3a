"""What jsonargparse says about a config or an argument that is wrong, as one line: where, what, and the nearest key."""

import re
from collections.abc import Sequence
from difflib import SequenceMatcher

from torchqm.cli.config_classes import allowed, arguments_of, class_fault
from torchqm.cli.config_places import on_one_line, place_of, sources_of

__all__ = ["explained", "nearest_key", "placed"]

_NEAR = 0.5
_GROUPS = ("model", "data", "checkpoint", "pictures")
_IN_CLASS = r"Problem with given class_path '[^']+':\s+Parser key \"([\w.]+)\":(.*?Given value: [^\n]*)"


def explained(message: str, keys: Sequence[str], args: Sequence[str]) -> str:
    r"""One line for an error of the parser.

    Args:
        message: what the parser says.
        keys: all that it knows, such as ``model.lr``.
        args: what it was given: ``--config FILE``, ``--model FILE``, ``--model.lr 3`` and so on.

    Example:
        >>> explained("unrecognized arguments: --model.lrr 3", ["model.lr", "data.root"], ["--model.lrr", "3"])
        '--model.lrr: no such option; the nearest is --model.lr'
        >>> explained('Parser key "model.k": Expected a <class \'int\'>. Got value: ten', ["model.k"], [])
        "model.k: 'ten' given, expected int"
    """
    sources = sources_of(args)
    if faults := [f"{source.place}: not readable as YAML ({source.fault})" for source in sources if source.fault]:
        return faults[0]
    if found := re.search(r"unrecognized arguments: (\S+)", message):
        word = found[1].split("=")[0]
        if not word.startswith("--"):
            return f"{word}: not expected here; options begin with '--'"
        return f"{word}: no such option; {_hint(word.removeprefix('--'), keys, '--')}"
    if found := re.search(r"does not accept option '([^']+)'", message):
        return f"{place_of(found[1], sources)}: no such key; {_hint(found[1], keys)}"
    head = re.match(r'(?:Parser key|argument) (?:--|")?([\w.]+)"?:', message)
    inner = re.search(r"Problem with given class_path '([^']+)':\s+Option '([^']+)' is not accepted", message)
    if head and inner:
        key = f"{head[1]}.init_args.{inner[2]}"
        return f"{place_of(key, sources)}: {inner[1]} has no such argument; {_hint(inner[2], arguments_of(inner[1]))}"
    if found := re.fullmatch(
        r"the following arguments are required: (?:fit\.|test\.|predict\.)?([\w.]+)", message.strip()
    ):
        return f"--{found[1]}: not given, but needed"
    if head and (fault := class_fault(message)):
        return f"{place_of(head[1], sources)}: {fault}"
    key = head[1] if head else ""
    if head and (inside := re.search(_IN_CLASS, message, re.DOTALL)):
        key, message = f"{key}.init_args.{inside[1]}", inside[2]
    expected = allowed(message)
    given = re.search(r"(?:Got value|Given value): (.*)", message, re.DOTALL)
    if head and expected and given:
        return f"{place_of(key, sources)}: {on_one_line(given[1])!r} given, expected {expected}"
    if head and (rest := on_one_line(message[head.end() :])):
        dashes = "--" if message.startswith("argument --") else ""
        return f"{dashes + head[1] if dashes else place_of(head[1], sources)}: {rest}"
    return on_one_line(message)


def placed(text: str, keys: Sequence[str], args: Sequence[str]) -> str:
    """A fault that is found when what a config names is made: with the group of the option and the file that has it.

    Args:
        text: the fault; if it begins with the name of an option of model, data, checkpoint or pictures, that is meant.
        keys: as in :func:`explained`.
        args: likewise.

    Example:
        >>> placed("tau: -1.0 given, expected a positive number", ["model.tau"], ["--model.tau", "-1"])
        '--model.tau: -1.0 given, expected a positive number'
        >>> placed("shapes/cat: the folder is empty", ["model.tau"], [])
        'shapes/cat: the folder is empty'
    """
    found = re.match(r"(?:(\w+)\.)?(\w+)(?=:| ')", text)
    if found is None:
        return text
    groups = (found[1],) if found[1] else _GROUPS
    key = next((f"{group}.{found[2]}" for group in groups if f"{group}.{found[2]}" in keys), None)
    return text if key is None else f"{place_of(key, sources_of(args))}{text[found.end() :]}"


def nearest_key(key: str, keys: Sequence[str]) -> str | None:
    """The key that looks most like a wrong one, by difflib's ratio; None if none does.

    A key without its group is compared with the last words.

    Example:
        >>> nearest_key("modle.lr", ["model.lr", "data.root"]), nearest_key("roots", ["model.lr", "data.root"])
        ('model.lr', 'data.root')
    """

    def likeness(other: str) -> float:
        whole = SequenceMatcher(None, key, other).ratio()
        return whole if "." in key else max(whole, 0.95 * SequenceMatcher(None, key, other.split(".")[-1]).ratio())

    best = max(keys, key=likeness, default=None)
    return best if best is not None and likeness(best) >= _NEAR else None


def _hint(key: str, keys: Sequence[str], dashes: str = "") -> str:
    near = nearest_key(key, keys)
    return f"the nearest is {dashes}{near}" if near else "none is near; see --help"
