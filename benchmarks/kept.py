"""Results that are kept between calls, and what they were made of: nothing is taken for what another config made.

Rows are measured again where anything differs, and that is said; a training, which takes long, is refused instead.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from torchqm.benchmark.plan import truth_digest
from torchqm.cli.sweep_plan import config_digest
from torchqm.data.base import ShapeSet, TruthError
from torchqm.geometry.files import write_whole
from torchqm.version import __version__

ABOUT = "made_of.json"
"""In the folder of a training: what it was made of."""


def made_of(config: Path, root: str | Path, **more: Any) -> dict[str, Any]:
    """What a result depends on: the config with all that it names, the data root, the version, and whatever else.

    Args:
        config: YAML file of ``torchqm fit``.
        root: of the data.
        **more: plain values.
    """
    found = {"config": config_digest(config), "root": str(root), "torchqm": __version__, **more}
    return json.loads(json.dumps(found))  # as it comes back from a file


def data_digest(shapes: ShapeSet, pairs: Iterable[tuple[str, str]]) -> str:
    """A digest of meshes and truths: a folder may hold others under the same names."""
    found = hashlib.sha256()
    pairs = list(pairs)
    for name in dict.fromkeys(name for pair in pairs for name in pair):
        path = shapes.path(name)
        found.update(f"{name};".encode())
        if path is None:
            found.update(str(shapes.root).encode())
            continue
        for file in (path, path.with_suffix(".tri")) if path.suffix == ".vert" else (path,):
            found.update(file.read_bytes())
    if shapes.layout != "synthetic":
        for pair in pairs:
            try:
                found.update(truth_digest(shapes.truth(*pair)).encode())
            except TruthError as error:
                found.update(type(error).__name__.encode())
    return found.hexdigest()[:16]


def differing(was: Any, now: Mapping[str, Any]) -> str:
    """The names of what differs."""
    if not isinstance(was, Mapping):
        return "everything"
    return ", ".join(sorted(name for name in {*was, *now} if was.get(name) != now.get(name)))


def kept_rows(path: Path, about: dict[str, Any], make: Callable[[], list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """The rows in a file, or made and written to it: if it is not there, cannot be read or is of something else."""
    if path.exists():
        try:
            content = json.loads(path.read_text())
            if content["about"] == about:
                return content["rows"]
            reason = f"made with another {differing(content['about'], about)}"
        except (ValueError, KeyError, TypeError) as error:
            reason = f"not readable ({type(error).__name__})"
        print(f"{path}: {reason}; it is made again", flush=True)
    rows = make()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: file.write(json.dumps({"about": about, "rows": rows}).encode()))
    return rows


def require_same(folder: Path, about: dict[str, Any]) -> None:
    """Let a training begin or go on in a folder, if it is empty or was made of the same.

    Raises:
        SystemExit: it was made of something else, or does not say of what.
    """
    path = folder / ABOUT
    if path.exists():
        try:
            differs = differing(json.loads(path.read_text()), about)
        except ValueError:
            differs = "everything (the file is damaged)"
    else:
        differs = "everything, for all one can tell" if folder.exists() and any(folder.iterdir()) else ""
    if differs:
        raise SystemExit(
            f"{folder}: has a training with another {differs} ({ABOUT}); give another --out, or delete the folder"
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: file.write((json.dumps(about, indent=1) + "\n").encode()))
