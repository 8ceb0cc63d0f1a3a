"""The results of a comparison run on disk: one JSON for each pair and method, whole or not there."""

import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from torchqm.matching.result import write_json

__all__ = ["FORMAT", "LedgerError", "clean", "file_name", "read_record", "write_record"]

FORMAT = 1
"""Of the JSON files; part of every key, so that files of another format are never taken for results of this one."""

_NEEDED = ("format", "key", "method", "source", "target", "kind", "status", "row", "errors")


class LedgerError(ValueError):
    """A result file that cannot be used; the message names it."""


def file_name(*names: str) -> str:
    """A file name of one or two shapes; what no file name can hold (the slash of DT4D's names) is escaped.

    Example:
        >>> file_name("crypto/Pose12", "cat0"), file_name("cat0")
        ('crypto%2FPose12+cat0', 'cat0')
    """
    return "+".join(quote(name, safe="") for name in names)  # `quote` escapes the plus, so it divides the two


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Write one result; a reader or a kill never meets half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"format": FORMAT, **record})


def read_record(path: Path, key: str) -> dict[str, Any] | None:
    """The result in a file; None if there is none, or if it belongs to other shapes or another format.

    Args:
        path: the file.
        key: what the result must have been made from; see :func:`torchqm.benchmark.plan.plan_tasks`.

    Raises:
        LedgerError: the file cannot be read, is cut short or holds something else.
    """
    try:
        text = path.read_text("utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise LedgerError(f"{path}: cannot be read ({error}); delete it to have this pair run again") from error
    try:
        record = json.loads(text)
    except json.JSONDecodeError as error:
        raise LedgerError(
            f"{path}:{error.lineno}: damaged or cut short ({error.msg}); delete it to have this pair run again"
        ) from error
    missing = [name for name in _NEEDED if name not in record] if isinstance(record, dict) else list(_NEEDED)
    if missing:
        raise LedgerError(f"{path}: no result of a pair ({missing[0]!r} is missing); delete it to have it run again")
    return record if record["format"] == FORMAT and record["key"] == key else None


def clean(out: Path, age: float = 0.0) -> None:
    """Remove what a killed run left half written; only while no other run writes to ``out``.

    Args:
        out: the folder.
        age: seconds; what is younger stays: workers of a cluster may still end what an interrupted run gave them.
    """
    for folder in ("results", "symmetries", "pictures"):
        for path in (out / folder).rglob(".*.part"):
            with suppress(FileNotFoundError):
                if age <= 0 or time.time() - path.stat().st_mtime > age:
                    path.unlink()
