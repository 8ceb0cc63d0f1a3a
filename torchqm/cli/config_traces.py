"""Where an error came from that was raised while the objects of a config were made, through jsonargparse."""

from traceback import walk_tb
from types import FrameType
from typing import Any

__all__ = ["causes", "group_made", "modules", "objects_made"]


def causes(error: BaseException) -> list[BaseException]:
    """The error, and what is behind it where jsonargparse raised it, the first error of other code last."""
    frames = _frames(error)
    if not _is_parsers(error):
        return [error]
    # It tried several kinds, and as cause it keeps the error of the first; they are all where it raised.
    tried = frames[-1].f_locals.get("exceptions", [error.__cause__])
    below = [causes(one) for one in tried if isinstance(one, BaseException)]
    found = next((path for path in below if not _is_parsers(path[-1])), [])
    return [error, *found]


def objects_made(error: BaseException) -> list[tuple[type, dict[str, Any]]]:
    """What jsonargparse was making when it happened: the class and its arguments, the innermost object last."""
    frames = [frame for one in causes(error) for frame in _frames(one)]
    values = [frame.f_locals for frame in frames if _module(frame) == "jsonargparse._instantiation"]
    return [(one["class_type"], one.get("kwargs", {})) for one in values if isinstance(one.get("class_type"), type)]


def group_made(error: BaseException) -> str:
    """The group of options that an object was made of, such as ``checkpoint``; empty if of none."""
    frames = [frame for one in causes(error) for frame in _frames(one) if _module(frame).startswith("jsonargparse.")]
    found = [frame.f_locals["group"] for frame in frames if "group" in frame.f_locals]
    return str(getattr(found[-1], "dest", "")) if found else ""


def modules(error: BaseException) -> list[str]:
    """The modules from where it was caught to where it was raised."""
    return [_module(frame) for one in causes(error) for frame in _frames(one)]


def _is_parsers(error: BaseException) -> bool:
    """Whether jsonargparse raised it."""
    return any(_module(frame).startswith("jsonargparse.") for frame in _frames(error)[-1:])


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__", ""))


def _frames(error: BaseException) -> list[FrameType]:
    return [frame for frame, _ in walk_tb(error.__traceback__)]
