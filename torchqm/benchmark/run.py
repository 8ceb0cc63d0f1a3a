"""One task of a comparison run, from the two meshes to the result file; what any process can do on its own."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from torch import Tensor

from torchqm.benchmark.ledger import read_record, write_record
from torchqm.benchmark.measure import Measured, measure_pair, measure_symmetry, undeformed
from torchqm.benchmark.plan import Task, functions_of, parameters_of
from torchqm.benchmark.symmetries import KeptCollection, match_ours
from torchqm.data.base import ShapeSet
from torchqm.data.folder import SameIdShapes
from torchqm.data.layouts import open_shapes
from torchqm.geometry import check_mesh
from torchqm.matching import PreparedShape, prepare
from torchqm.matching.baselines import BaselineResult, Given, Ours
from torchqm.matching.parameters import MatchError
from torchqm.symmetry import find_reflection
from torchqm.symmetry.group import SymmetryGroup

__all__ = ["fail_task", "map_path", "run_task"]

NOTED = (UserWarning, RuntimeWarning)
"""Warnings that become notes of a result; others are about code, not about shapes."""


def map_path(result: Path) -> Path:
    """The file with the map that belongs to a result file."""
    return result.with_name(result.name.removesuffix(".json") + ".map.npz")


def run_task(task: Task) -> str:
    """Do a task and write its result file, last of all files, so that its being there says that all is done.

    A task whose file is there is done: a process may die between writing it and saying so. Without the file it is done
    again.

    Returns:
        ``done``, ``failed`` (the file has the reason) or ``none`` (a shape whose true symmetry is not known).
    """
    there = read_record(task.path, task.key)
    if there is not None:
        return str(there["status"])
    began = perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        for category in NOTED:
            warnings.simplefilter("always", category)
        try:
            record = _pair(task) if task.kind == "pair" else _symmetry(task)
        except Exception as error:  # whatever it is, it belongs to this pair alone
            text = " ".join(str(error).split())
            reason = text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}"
            fail_task(task, reason, _said(caught))
            return "failed"
    record["notes"] = [*record.get("notes", []), *_said(caught)]
    record["wall_seconds"] = round(perf_counter() - began, 3)
    write_record(task.path, _head(task) | record)
    return str(record["status"])


def fail_task(task: Task, reason: str, notes: Sequence[str] = ()) -> None:
    """Write the result file of a task that failed."""
    found = {"status": "failed", "reason": reason, "row": {}, "errors": {}, "notes": list(notes)}
    write_record(task.path, _head(task) | found)


def _said(caught: Sequence[warnings.WarningMessage]) -> list[str]:
    return list(dict.fromkeys(str(warning.message) for warning in caught if issubclass(warning.category, NOTED)))


def _head(task: Task) -> dict[str, Any]:
    return {
        "key": task.key,
        "method": task.matcher.name,
        "source": task.source,
        "target": task.target,
        "kind": task.kind,
    }


@dataclass(frozen=True)
class _Shape:
    """What makes a prepared shape; equal ones are the same object."""

    root: str
    name: str
    print: str
    functions: int
    cache: Path | None


@lru_cache(maxsize=2)
def _shapes(root: str) -> ShapeSet:
    return open_shapes(root)


@lru_cache(maxsize=6)
def _prepared(shape: _Shape) -> PreparedShape:
    """A mesh with its eigenpairs; of a small one half as many as it has vertices, as in ``torchqm match``."""
    mesh = _shapes(shape.root).mesh(shape.name)
    check_mesh(mesh)
    usable = int((mesh.normalized().vertex_areas > 0).sum())
    k = shape.functions if usable // 2 >= shape.functions else max(min(30, shape.functions), usable // 2)
    return prepare(mesh, k, cache_dir=shape.cache)


def _both(task: Task) -> tuple[PreparedShape, PreparedShape]:
    k, (first, second) = functions_of(task.matcher), task.prints
    root, cache = task.settings.root, task.settings.cache
    return _prepared(_Shape(root, task.source, first, k, cache)), _prepared(_Shape(root, task.target, second, k, cache))


def _reference(task: Task, shapes: ShapeSet) -> PreparedShape | None:
    """The undeformed pose of the class of both shapes, if there is one."""
    cls = shapes.shape_class(task.target)
    name = undeformed(shapes, cls) if shapes.shape_class(task.source) == cls else None
    if name is None:
        return None
    known = dict(zip((task.source, task.target), task.prints, strict=True))
    shape = _Shape(task.settings.root, name, known.get(name, ""), functions_of(task.matcher), task.settings.cache)
    return _prepared(shape)


def _given(task: Task, shapes: ShapeSet) -> Given:
    """What a method may be told; only what it cannot do without, or uses where it is there."""
    needs, matcher = task.matcher.needs, task.matcher
    tables: list[Tensor | None] = [None, None]
    sides: list[Tensor | None] = [None, None]
    if "symmetry" in needs:
        for i, name in enumerate((task.source, task.target)):
            group = shapes.symmetry(name)
            if group is None:
                raise MatchError(f"{matcher.name}: the true symmetry of {name} is needed, and the set does not have it")
            tables[i], sides[i] = group.maps, _side(shapes, shapes.shape_class(name), group)
    known = isinstance(matcher, Ours) and matcher.axis == "known"
    reference = _reference(task, shapes) if known or "reference" in needs else None
    return Given(tables[0], tables[1], sides[0], sides[1], reference=reference)


def _side(shapes: ShapeSet, cls: str, group: SymmetryGroup) -> Tensor | None:
    """Distance from the mirror plane of the undeformed pose, where its vertex ids are those of all poses."""
    pose = undeformed(shapes, cls) if isinstance(shapes, SameIdShapes) else None
    if pose is None or group.order != 2:
        return None
    mesh = shapes.mesh(pose)
    return find_reflection(mesh).side(mesh.verts)


def _collection(task: Task, matcher: Ours) -> KeptCollection:
    folder = task.settings.out / "symmetries"
    return KeptCollection(folder, matcher.method, parameters_of(matcher), matcher.descriptors)


def _pair(task: Task) -> dict[str, Any]:
    shapes, (x, y) = _shapes(task.settings.root), _both(task)
    given = _given(task, shapes)
    if isinstance(task.matcher, Ours):
        result = match_ours(task.matcher, x, y, given, _collection(task, task.matcher))
    else:
        result = task.matcher.match(x, y, given)
    measured = measure_pair(shapes, task.source, task.target, result.best, task.settings)
    _keep_map(task, result.best)
    return _record(measured, result) | {"class": shapes.shape_class(task.source)}


def _symmetry(task: Task) -> dict[str, Any]:
    shapes, (x, _) = _shapes(task.settings.root), _both(task)
    if shapes.symmetry_truth(task.source) is None:
        return {"status": "none", "reason": "the set knows no true reflection of it", "row": {}, "errors": {}}
    if isinstance(task.matcher, Ours):
        collection = _collection(task, task.matcher)
        known = task.matcher.symmetry(x, _given(task, shapes).reference, collection)
        turned = (known.orientation < 0).nonzero().flatten().tolist()
        if not turned:
            raise MatchError("; ".join(["no reflection was found", *known.warnings]))
        seconds = {"symmetries": collection.symmetry_seconds}
        maps = known.group.maps[turned[0]][None]
        notes = [f"{known.name}, {known.origin}", *known.warnings]
        result = BaselineResult(task.matcher.name, maps, ("mirrored",), seconds, notes)
    else:
        result = task.matcher.match(x, x, _given(task, shapes))
    measured = measure_symmetry(shapes, task.source, result.best, task.settings)
    assert measured is not None  # asked above
    _keep_map(task, result.best)
    return _record(measured, result) | {"class": shapes.shape_class(task.source)}


def _record(measured: Measured, result: BaselineResult) -> dict[str, Any]:
    row = measured.row | {"label": result.labels[0], "seconds": round(result.seconds, 4)}
    if "symmetries" in result.steps:
        row["seconds_symmetry"] = round(result.steps["symmetries"], 4)
    errors = {name: [float(f"{value:.6g}") for value in values] for name, values in measured.errors.items()}
    return {"status": "done", "row": row, "errors": errors, "steps": result.steps, "notes": result.notes}


def _keep_map(task: Task, p2p: Tensor) -> None:
    from torchqm.matching.result import write_npz

    path = map_path(task.path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_npz(path, p2p=p2p.numpy().astype(np.int32))
