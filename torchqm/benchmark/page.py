"""A page with pictures of the worst pairs of each method."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from math import inf
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch

from torchqm.benchmark.ledger import file_name
from torchqm.benchmark.plan import Task
from torchqm.benchmark.run import map_path
from torchqm.benchmark.summary import read_records
from torchqm.data.base import TruthError
from torchqm.data.layouts import open_shapes
from torchqm.geometry.files import write_whole

__all__ = ["Picture", "draw_picture", "write_page"]

_ORDER = ("map", "plain", "symmetry")
"""By which mean error pairs are sorted: the first that a pair has."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 1100px; padding: 0 1em; color: #222 }
figure { margin: 1em 0 2em; border: 1px solid #ddd; border-radius: 4px; padding: 1em }
img { max-width: 100%; height: auto }
figcaption { font-size: 14px } h2 { margin-top: 2em } code, .reason { color: #a33 }
"""


@dataclass(frozen=True)
class Picture:
    """What a process draws.

    Args:
        root: the set.
        source: shape that is mapped.
        target: shape that it is mapped to.
        kind: ``pair`` or ``symmetry``.
        map: file of the map.
        path: the picture.
        title: above it.
    """

    root: str
    source: str
    target: str
    kind: str
    map: Path
    path: Path
    title: str


def draw_picture(picture: Picture) -> Path:
    """The target's coordinates as colours on the source: as the map found brings them back, as the true map does.

    Where the truth is known at all vertices, a third shape shows how far the two are apart.
    """
    from torchqm.viz import scalar_figure, xyz_colors

    shapes = open_shapes(picture.root)
    source, target = shapes.mesh(picture.source), shapes.mesh(picture.target)
    with np.load(picture.map, allow_pickle=False) as kept:
        found = torch.from_numpy(kept["p2p"].astype(np.int64))
    colors = xyz_colors(target)
    fields: dict[str, Any] = {"found": colors[found.numpy()]}
    try:
        itself = picture.kind == "symmetry"
        truth = shapes.symmetry_truth(picture.source) if itself else shapes.truth(picture.source, picture.target)
    except TruthError:
        truth = None
    if truth is not None and torch.equal(truth.at, torch.arange(source.n_verts)):
        fields["truth"] = colors[truth.vertices.numpy()]
        apart = (target.verts[found] - target.verts[truth.vertices]).norm(dim=1) / target.area**0.5
        fields["apart, in space / √area"] = apart
    return scalar_figure(source, fields, picture.path, title=picture.title)


def write_page(
    tasks: Sequence[Task],
    out: Path,
    title: str,
    worst: int,
    draw: Callable[[Sequence[Picture]], Iterable[tuple[int, Any]]],
) -> Path:
    """Write ``worst.html`` with its pictures in ``pictures``; pictures of an earlier run are used again.

    Args:
        tasks: of the run.
        out: the folder.
        title: of the page.
        worst: pairs of each method.
        draw: gives for pictures the number of each and its file, or something with a ``reason`` where it failed.

    Returns:
        The page.
    """
    done: dict[str, list[tuple[float, Task, dict[str, Any]]]] = {}
    failed: list[tuple[Task, dict[str, Any]]] = []
    for task, record in read_records(tasks):
        if record["status"] == "done":
            done.setdefault(task.matcher.name, []).append((_error(record["row"])[1], task, record))
        elif record["status"] == "failed":
            failed.append((task, record))
    shown = {name: sorted(rows, key=lambda row: -row[0])[:worst] for name, rows in done.items()}
    pictures: list[Picture] = []
    for name, rows in shown.items():
        for _, task, _ in rows:
            path = out / "pictures" / f"{file_name(name, task.source, task.target, task.kind)}-{task.key[:8]}.png"
            pictures.append(
                Picture(task.settings.root, task.source, task.target, task.kind, map_path(task.path), path, task.label)
            )
    missing = [picture for picture in pictures if not picture.path.is_file()]
    reasons = {
        missing[number].path: str(result.reason) for number, result in draw(missing) if hasattr(result, "reason")
    }
    parts = [f"<h1>{escape(title)}: the worst pairs</h1>"]
    parts.append(f"<p>Of each method the {worst} pairs with the largest mean error; then the pairs that failed.</p>")
    of = iter(pictures)
    for name, rows in shown.items():
        parts.append(f"<h2>{escape(name)}</h2>")
        parts += [_figure(next(of), record, out, reasons) for _, _, record in rows]
    if failed:
        parts.append("<h2>Failed</h2><ul>")
        parts += [
            f'<li>{escape(task.label)}: <span class="reason">{escape(str(record["reason"]))}</span></li>'
            for task, record in failed
        ]
        parts.append("</ul>")
    text = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>\n" + "\n".join(parts) + "\n</body></html>\n"
    )
    return write_whole(out / "worst.html", lambda file: file.write(text.encode()))


def _error(row: dict[str, Any]) -> tuple[str, float]:
    for name in _ORDER:
        if f"{name}_median" in row:  # a mean that is infinite is kept as null
            value = row.get(f"{name}_mean")
            return name, inf if value is None else float(value)
    return "", inf


def _figure(picture: Picture, record: dict[str, Any], out: Path, reasons: dict[Path, str]) -> str:
    row = record["row"]
    numbers = [
        f"{name} {'infinite' if row[f'{name}_mean'] is None else format(row[f'{name}_mean'], '.4f')}"
        for name in (*_ORDER, "orbit")
        if f"{name}_mean" in row
    ]
    caption = f"<b>{escape(picture.source)} → {escape(picture.target)}</b>: mean error {', '.join(numbers)}"
    if "flip_map" in row:
        caption += (
            f"; {'flipped as a whole' if row['flip_map'] else 'not flipped'}, {row['flip_points']:.0%} of the points"
        )
    caption += f"; {row['seconds']:.1f} s"
    if record.get("notes"):
        caption += "<br>" + "<br>".join(escape(note) for note in record["notes"])
    if picture.path in reasons:
        body = f'<p class="reason">no picture: {escape(reasons[picture.path])}</p>'
    else:
        link = quote(picture.path.relative_to(out).as_posix())
        body = f'<img src="{link}" alt="{escape(picture.title)}" loading="lazy">'
    return f"<figure>{body}<figcaption>{caption}</figcaption></figure>"
