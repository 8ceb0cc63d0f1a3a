"""From the results of a run to its rows, curves, tables and figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

import torch

from torchqm.benchmark.ledger import read_record
from torchqm.benchmark.plan import PUBLISHED, Task
from torchqm.data.published import load_published
from torchqm.evaluate.protocol import ErrorReport, make_report
from torchqm.evaluate.report import FIGURES, MethodCurve, write_report

__all__ = ["PublishedRows", "make_curves", "make_rows", "read_published_rows", "write_summary"]

Record = dict[str, Any]


@dataclass(frozen=True, eq=False)
class PublishedRows:
    """A published method on the pairs of a run.

    Args:
        method: with ``published:``.
        rows: for the table of pairs.
        reports: by protocol.
    """

    method: str
    rows: list[Record]
    reports: dict[str, list[ErrorReport]]


def read_published_rows(root: str | Path, method: str, pairs: Sequence[tuple[str, str]]) -> PublishedRows:
    """The published results of a method on those pairs that have one.

    ``plain`` is at the benchmark's 1024 samples, ``map`` at the landmarks of the class: there, and only there, the
    files forgive a flip.

    Args:
        root: the set.
        method: as in the file names.
        pairs: of the run.

    Raises:
        FileNotFoundError: the set has no result of the method.
        ValueError: a file is malformed or cut short (file and line are named), or has none of the pairs.
    """
    found = {(result.source, result.target): result for result in load_published(root, method)}
    rows, reports = [], dict[str, list[ErrorReport]]()
    for pair in pairs:
        if pair not in found:
            continue
        result = found[pair]
        mine = [make_report("plain", result.plain.errors, solver="published")]
        if result.landmarks is not None:
            mine.append(make_report("map", result.landmarks.errors, solver="published"))
        row: Record = {"method": PUBLISHED + method, "source": pair[0], "target": pair[1]}
        row |= {"points": len(result.plain.errors), "solver": "published"}
        for report in mine:
            row |= report.to_row()
            reports.setdefault(report.protocol, []).append(report)
        if result.landmarks is not None:
            row |= {"points_mirrored": len(result.landmarks.errors), "flip_map": result.landmarks.flipped}
        rows.append(row | {"seconds": result.seconds})
    if not rows:
        raise ValueError(f"{PUBLISHED}{method}: {root} has no result of it for any of the {len(pairs)} pairs")
    return PublishedRows(PUBLISHED + method, rows, reports)


def read_records(tasks: Sequence[Task]) -> list[tuple[Task, Record]]:
    """The results that are there, in the order of the tasks.

    Raises:
        LedgerError: a file that is cut short.
    """
    found = [(task, read_record(task.path, task.key)) for task in tasks]
    return [(task, record) for task, record in found if record is not None]


def make_rows(records: Sequence[Record]) -> list[Record]:
    """One row for each method and pair; the symmetry of a shape is a row of the shape with itself."""
    rows: dict[tuple[str, str, str], Record] = {}
    for record in records:
        if record["status"] == "none":
            continue
        name = record["method"], record["source"], record["target"]
        row = {"method": name[0], "source": name[1], "target": name[2], "class": record.get("class")}
        for key, value in record["row"].items():  # JSON has no infinity
            row[key] = inf if value is None and key.endswith(("_mean", "_median")) else value
        if record["status"] == "failed":
            row["reason"] = record.get("reason") or "failed"
        if record.get("notes"):
            row["notes"] = "; ".join(record["notes"])
        if name in rows:  # a pair of a shape with itself, and its symmetry
            earlier, more = rows[name], {key: row[key] for key in row if key.startswith("symmetry_")}
            reasons = [part for part in (earlier.get("reason"), row.get("reason")) if part]
            row = row | earlier | more | ({"reason": "; ".join(reasons)} if reasons else {})
        rows[name] = row
    return list(rows.values())


def make_curves(
    records: Sequence[Record], published: Sequence[PublishedRows] = ()
) -> dict[str, dict[str, MethodCurve]]:
    """The curves of each figure, by protocol and method."""
    reports: dict[str, dict[str, list[ErrorReport]]] = {}
    for record in records:
        for protocol, errors in record["errors"].items():
            values = torch.tensor([inf if e is None else e for e in errors], dtype=torch.float64)
            methods = reports.setdefault(protocol, {})
            methods.setdefault(record["method"], []).append(make_report(protocol, values))
    curves = {
        protocol: {method: MethodCurve.from_reports(found) for method, found in methods.items()}
        for protocol, methods in reports.items()
    }
    for other in published:
        for protocol, found in other.reports.items():
            name = f"{other.method}{', landmarks' if protocol == 'map' else ''}"
            curves.setdefault(protocol, {})[name] = MethodCurve.from_reports(found, published=True)
    return {protocol: curves[protocol] for protocol in FIGURES if protocol in curves}


def write_summary(
    tasks: Sequence[Task], published: Sequence[PublishedRows], out: Path, title: str
) -> tuple[list[Record], Mapping[str, Path]]:
    """Write ``pairs.csv``, ``table.md`` and the figures of what is there.

    Args:
        tasks: of the run; those without a result are left out.
        published: others' results.
        out: the folder.
        title: of the table.

    Returns:
        The rows, and the files by name.

    Raises:
        LedgerError: a result file that is cut short.
        ValueError: there is no result at all.
    """
    records = [record for _, record in read_records(tasks)]
    rows = make_rows(records) + [row for other in published for row in other.rows]
    return rows, write_report(rows, make_curves(records, published), out, title)
