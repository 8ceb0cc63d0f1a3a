"""Results of the runs of a sweep: kept beside each run, and taken only for what they were made from; the tables."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from torchqm.cli.console import UserError
from torchqm.cli.sweep_plan import Run, word
from torchqm.version import __version__

__all__ = ["RESULT", "STARTED", "kept_result", "write_result", "write_tables"]

RESULT, STARTED = "result.json", "started.json"
"""Files in the folder of a run: what came out of it, and what it was begun from."""


def kept_result(folder: Path, run: Run) -> Any:
    """The result of a finished run, None if it must be run.

    Raises:
        UserError: a run with other arguments, of a config that was changed or of another version of torchqm, a damaged
            result, or something that is no run.
    """
    if not folder.exists():
        return None
    for name in (RESULT, STARTED):
        if (folder / name).is_file():
            found = _read(folder / name)
            if found.get("config") != run.digest:
                raise UserError(
                    f"{folder}: has a run of a config that was changed since ({name}); its results would be mixed with "
                    "others: take another folder, or delete this one"
                )
            if found.get("torchqm") != __version__:
                was = f"torchqm {found['torchqm']}" if "torchqm" in found else "an earlier torchqm that did not say so"
                raise UserError(
                    f"{folder}: has a run of {was} ({name}), this is {__version__}; its results would be mixed with "
                    "others: take another folder, or delete this one"
                )
            if found.get("arguments") != list(run.arguments):
                raise UserError(f"{folder}: has a run with other arguments ({name}); give another --out, or remove it")
            return found if name == RESULT and found["status"] == "done" else None  # what failed is tried again
    raise UserError(f"{folder}: exists, but is no run of a sweep; give another --out, or remove it")


def write_result(path: Path, values: Mapping[str, Any]) -> None:
    """Write a file of a run, whole or not at all."""
    from torchqm.geometry.files import write_whole

    text = json.dumps(values, indent=1) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))


def write_tables(rows: Sequence[Mapping[str, Any]], labels: Sequence[str], out: Path) -> str:
    """Write ``sweep.csv``, a row for each run, and ``sweep.md``, mean and deviation over seeds; the latter's text."""
    from torchqm.geometry.files import write_whole

    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = io.StringIO()
    writer = csv.DictWriter(table, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    values = [name for name in columns if name not in {"run", *labels, "seed", "status"}]
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(word(row.get(label, "")) for label in labels), []).append(row)
    lines = [[*labels, "seeds", *values], ["---"] * (len(labels) + 1 + len(values))]
    for point, members in groups.items():
        done = [row for row in members if row["status"] == "done"]
        count = f"{len(done)}" if len(done) == len(members) else f"{len(done)} of {len(members)}"
        lines.append([*point, count, *(_spread([row[name] for row in done if name in row]) for name in values)])
    text = "".join(f"| {' | '.join(line)} |\n" for line in lines)
    failed = [f"- {row['run']}: {row['status']}\n" for row in rows if row["status"] != "done"]
    text += "\n" + "".join(failed) if failed else ""
    write_whole(out / "sweep.csv", lambda file: file.write(table.getvalue().encode()))
    write_whole(out / "sweep.md", lambda file: file.write(text.encode()))
    return text


def _spread(values: Sequence[float]) -> str:
    if not values:
        return ""
    return f"{mean(values):.4g}" + (f" ± {stdev(values):.2g}" if len(values) > 1 else "")


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text())
    except ValueError as error:
        raise UserError(f"{path}: damaged ({error}); delete the folder to have the run made again") from error
    if not isinstance(found, dict):
        raise UserError(f"{path}: no result of a run; give another --out, or remove it")
    return found
