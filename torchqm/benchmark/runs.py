"""``run.json``: which commands wrote the results of an output folder, where, and with which versions."""

import json
import os
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from torchqm.matching.result import write_json
from torchqm.version import __version__

__all__ = ["begin_run", "end_run", "write_report"]

_NAME = "run.json"


def begin_run(out: Path, arguments: Mapping[str, Any], backend: Mapping[str, Any]) -> None:
    """Note a run before its first result is written: one that is killed has written some, too.

    Args:
        out: the output folder.
        arguments: of the command, as plain values.
        backend: what runs the tasks.
    """
    kept = _read(out)
    packages = ("torch", "numpy", "scipy")
    versions = {"torchqm": __version__, "python": platform.python_version()}
    versions |= {name: metadata.version(name) for name in packages}
    machine = {"system": f"{platform.system()} {platform.machine()}", "cpus": os.cpu_count()}
    new = {
        "begun": datetime.now(UTC).isoformat(timespec="seconds"),
        "results": None,
        "arguments": dict(arguments),
        "backend": dict(backend),
        "versions": versions,
        "machine": machine,
    }
    write_json(out / _NAME, {**kept, "runs": [*kept["runs"], new]})


def end_run(out: Path, results: int, backend: Mapping[str, Any]) -> None:
    """Note how many results the run that was begun last has written, and what ran them in the end."""
    kept = _read(out)
    kept["runs"][-1] |= {"results": results, "backend": dict(backend)}
    write_json(out / _NAME, kept)


def write_report(out: Path, arguments: Mapping[str, Any]) -> None:
    """Note with which arguments tables and figures were made; the runs stay as they are."""
    write_json(out / _NAME, {**_read(out), "arguments": dict(arguments)})


def _read(out: Path) -> dict[str, Any]:
    """What stands there; nothing where a file is missing or damaged: results do not depend on it."""
    try:
        found = json.loads((out / _NAME).read_text("utf-8"))
    except (OSError, ValueError):
        found = {}
    if not isinstance(found, dict):
        found = {}
    runs = found.get("runs")
    if runs is None:  # the file of a version that kept one run alone
        runs = [{"results": None, **found}] if found else []
    return {
        "arguments": found.get("arguments", {}),
        "runs": [run for run in runs if isinstance(run, dict)] if isinstance(runs, list) else [],
    }
