"""What jsonargparse says about types and classes of a config, read: what is allowed, and the class that was meant."""

import re
from collections.abc import Iterator
from difflib import get_close_matches
from importlib import import_module
from inspect import signature
from pkgutil import iter_modules
from typing import Any

__all__ = ["allowed", "arguments_of", "class_fault"]

_NAMES = {
    "NoneType": "null",
    "list": "a list",
    "dict": "keys and values",
    "collections.abc.Iterable": "a list",
    "collections.abc.Sequence": "a list",
}


def allowed(message: str) -> str:
    """What an option may be, in words; of several kinds null is the last, since it is seldom what was meant.

    Example:
        >>> allowed("Expected a <class 'NoneType'>, Expected a <class 'int'>")
        'int or null'
        >>> allowed("Expected a typing.Literal['16', '32'], Expected a <class 'NoneType'>")
        'one of 16, 32 or null'
    """
    words = []
    values = [
        value for found in re.findall(r"Expected a typing\.Literal\[(.*?)\]", message) for value in found.split(",")
    ]
    if values:
        plain = dict.fromkeys(value.replace("'", "").strip() for value in values)
        words.append(f"one of {', '.join(plain)}")
    words += [f"the dotted name of a {name}" for name in re.findall(r"Not a valid subclass of (\w+)", message)]
    words += [_NAMES.get(name, name) for name in re.findall(r"Expected a <class '([\w.]+)'>", message)]
    return " or ".join(sorted(dict.fromkeys(words), key=lambda word: word == "null"))


def class_fault(message: str) -> str:
    """What is wrong with the name of a class, and the nearest name; empty if the message is about something else."""
    if found := re.search(r"module '([\w.]+)' has no attribute '(\w+)'", message):
        classes = [name for name, value in vars(import_module(found[1])).items() if isinstance(value, type)]
        return f"there is no {found[1]}.{found[2]}; {_hint(found[2], classes, f'{found[1]}.')}"
    found, path = re.search(r"No module named '([\w.]+)'", message), re.search(r"given class_path '([\w.]+)'", message)
    if found and path and path[1].startswith(f"{found[1]}."):  # else the class is there, and a package it needs is not
        above, _, last = found[1].rpartition(".")
        modules = [part.name for part in iter_modules(import_module(above).__path__)] if above else []
        return f"there is no module {found[1]}; {_hint(last, modules, f'{above}.')}"
    if found := re.search(r"Expected a dot import path string: (\w+)", message):
        bases = re.search(r"Subtypes: (.*)", message)
        known = {
            c.__name__: c for base in re.findall(r"\w+(?:\.\w+)+", bases[1] if bases else "") for c in _below(base)
        }
        near = get_close_matches(found[1], known, 1, 0.5)
        hint = f"the nearest is {known[near[0]].__module__}.{near[0]}" if near else "none that is loaded is near"
        return f"{found[1]!r} given, expected the dotted name of a class; {hint}"
    return ""


def arguments_of(class_path: str) -> list[str]:
    """The names of a class's arguments."""
    module, _, name = class_path.rpartition(".")
    return [key for key in signature(getattr(import_module(module), name)).parameters if key != "self"]


def _hint(name: str, names: list[str], front: str) -> str:
    near = get_close_matches(name, names, 1, 0.5)
    return f"the nearest is {front}{near[0]}" if near else "none is near"


def _below(class_path: str) -> Iterator[type]:
    """The classes that are loaded and made from one."""
    module, _, name = class_path.rpartition(".")
    first = getattr(import_module(module), name)
    above: list[type[Any]] = [first] if isinstance(first, type) else []  # typing.Union is none
    while above:
        for one in above.pop().__subclasses__():
            above.append(one)
            yield one
