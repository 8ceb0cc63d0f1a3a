"""Per-pair rows of a comparison as CSV and as one Markdown table of means."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from math import isnan
from statistics import median
from typing import Any

from torchqm.evaluate.protocol import PROTOCOLS, SHARES

__all__ = ["Row", "checked_rows", "csv_text", "markdown_table"]

Row = Mapping[str, Any]

_HEAD = ("protocol", "method", "pairs", "failed", "mean", "common", "worst pair", "median", "AUC")
_TAIL = ("flipped points", "flipped maps", "seconds", "solver")


def markdown_table(rows: Sequence[Row], title: str = "Comparison") -> str:
    """One table: a line for each protocol and method with the means over its pairs, each pair counting once.

    ``pairs`` is how many are behind a line; ``common`` is the mean over the pairs that all methods of the protocol
    solved, the only fair comparison where some failed. Below the table, the pairs that failed, with their reasons.

    Args:
        rows: as for :func:`torchqm.evaluate.report.write_report`.
        title: the heading.

    Raises:
        ValueError: naming what is wrong with a row.

    Example:
        >>> row = {"method": "ours", "source": "cat0", "target": "cat1", "map_mean": 0.02}
        >>> print(markdown_table([row]).splitlines()[4])  # doctest: +ELLIPSIS
        | map | ours | 1 | 0 | 0.0200 | 0.0200 (1) | 0.0200 cat0 → cat1 | ...
    """
    rows = checked_rows(rows)
    shares = [f"≤ {threshold:g}" for threshold in SHARES]
    head = [*_HEAD, *shares, *_TAIL]
    lines = [f"# {title}", "", _line(head), _line(["---"] * 2 + ["---:"] * (len(head) - 3) + ["---"])]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for protocol in _protocols(rows):
        solved = {
            method: {_pair(row): row for row in rows if row["method"] == method and _given(row, f"{protocol}_mean")}
            for method in methods
        }
        common = set.intersection(*(set(pairs) for pairs in solved.values() if pairs))
        for method in methods:
            itself = protocol == "symmetry"  # its rows are of a shape with itself
            failed = sum(_failed(row) and (row["source"] == row["target"]) == itself for row in _of(rows, method))
            if solved[method]:
                lines.append(_line(_cells(protocol, method, solved[method], common, failed)))
    lone = [m for m in methods if not any(_given(row, f"{p}_mean") for p in _protocols(rows) for row in _of(rows, m))]
    lines += [_line(["", method, 0, len(_of(rows, method)), *[""] * (len(head) - 4)]) for method in lone]
    lines += [
        "",
        "Geodesic error / √area of the target, means over pairs. `common`: mean over the pairs that all methods of the "
        "protocol solved (their number). Shares: points with at most this error. `seconds`: median over pairs.",
    ]
    if failures := [row for row in rows if _failed(row)]:
        lines += ["", f"{len(failures)} failed:", ""]
        lines += [f"* {_text(row['method'])}, {' → '.join(_pair(row))}: {_text(row['reason'])}" for row in failures]
    return "\n".join(lines) + "\n"


def _cells(
    protocol: str, method: str, pairs: Mapping[tuple[str, str], Row], common: set[tuple[str, str]], failed: int
) -> list[object]:
    rows = list(pairs.values())
    worst = max(pairs, key=lambda pair: float(pairs[pair][f"{protocol}_mean"]))
    shared = [float(pairs[pair][f"{protocol}_mean"]) for pair in pairs if pair in common]
    below = [_mean(rows, f"{protocol}_below_{threshold}", 3) for threshold in SHARES]
    seconds = [float(row["seconds"]) for row in rows if _given(row, "seconds")]
    return [
        protocol,
        method,
        len(rows),
        failed,
        _mean(rows, f"{protocol}_mean"),
        f"{sum(shared) / len(shared):.4f} ({len(shared)})" if shared else "",
        f"{float(pairs[worst][f'{protocol}_mean']):.4f} {worst[0]} → {worst[1]}",
        _mean(rows, f"{protocol}_median"),
        _mean(rows, f"{protocol}_auc", 3),
        *below,
        _mean(rows, "flip_points", 3),
        _mean(rows, "flip_map", 3),
        f"{median(seconds):.1f}" if seconds else "",
        ", ".join(sorted({str(row["solver"]) for row in rows if row.get("solver")})),
    ]


def _mean(rows: Sequence[Row], key: str, digits: int = 4) -> str:
    values = [float(row[key]) for row in rows if _given(row, key)]
    return f"{sum(values) / len(values):.{digits}f}" if values else ""


def _of(rows: Sequence[Row], method: str) -> list[Row]:
    return [row for row in rows if row["method"] == method]


def _pair(row: Row) -> tuple[str, str]:
    return row["source"], row["target"]


def _given(row: Row, key: str) -> bool:
    value = row.get(key)
    return isinstance(value, int | float) and not isnan(value)


def _failed(row: Row) -> bool:
    return bool(row.get("reason"))


def _protocols(rows: Sequence[Row]) -> list[str]:
    """Protocols with a mean in some row: those of the package in their order, then others by name."""
    found = {key.removesuffix("_mean") for row in rows for key in row if key.endswith("_mean") and _given(row, key)}
    return [name for name in PROTOCOLS if name in found] + sorted(found - set(PROTOCOLS))


def checked_rows(rows: Sequence[Row]) -> list[Row]:
    """The rows, if each names a method, a source and a target, and no three of them occur twice.

    Raises:
        ValueError: naming the row that does not, or if there are none.
    """
    if not rows:
        raise ValueError("rows: expected one row or more, got none")
    seen: set[tuple[str, str, str]] = set()
    for number, row in enumerate(rows):
        for key in ("method", "source", "target"):
            if not isinstance(row.get(key), str) or not row[key]:
                raise ValueError(f"rows[{number}]: expected a name under {key!r}, got {row.get(key)!r}")
        name = row["method"], row["source"], row["target"]
        if name in seen:
            raise ValueError(f"rows[{number}]: a second row of {name[0]} for {name[1]} -> {name[2]}")
        seen.add(name)
    return list(rows)


def csv_text(rows: Sequence[Row]) -> str:
    """All rows and all their columns, in the order in which they first occur; an empty cell where a row has none.

    Example:
        >>> print(csv_text([{"method": "a", "source": "x", "target": "y", "flip_map": True}]), end="")
        method,source,target,flip_map
        a,x,y,true
    """
    columns = list(dict.fromkeys(["method", "source", "target", *(key for row in rows for key in row)]))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_csv_value(row.get(column)) for column in columns])
    return text.getvalue()


def _csv_value(value: object) -> object:
    if isinstance(value, bool):
        return str(value).lower()
    return json.dumps(value) if isinstance(value, Mapping | list | tuple) else value  # None: an empty cell


def _line(cells: Sequence[object]) -> str:
    return "| " + " | ".join(_text(cell) for cell in cells) + " |"


def _text(value: object) -> str:
    """In one line, and no column of its own."""
    return " ".join(str(value).split()).replace("|", "\\|")
