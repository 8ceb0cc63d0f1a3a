"""Figures of shapes: maps and symmetries as colours, fields with colour bars (charts: :mod:`torchqm.viz.charts`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int, Shaped
from torch import Tensor

from torchqm.geometry.mesh import Mesh
from torchqm.viz.camera import FRONT, View, auto_frame, project, up_scores
from torchqm.viz.charts import bar_figure, curve_points, error_curves, line_figure, new_figure, save_figure
from torchqm.viz.render import render_mesh, to_rgb, xyz_colors

if TYPE_CHECKING:
    import matplotlib.axes
    import matplotlib.cm
    import matplotlib.figure

__all__ = [
    "bar_figure",
    "curve_points",
    "error_curves",
    "line_figure",
    "match_figure",
    "scalar_figure",
    "symmetry_figure",
]

CLASS_COLORS = ("#4C9FD6", "#E88A4A", "#3DB38A", "#D79BBC", "#F0C75E", "#8C8C8C", "#6A5ACD")
MAX_MAPS = 16
PANEL_AREA = 6.2  # square inches


@dataclass
class _Panel:
    """One shape in one colouring, and where it is looked at from."""

    mesh: Mesh
    colors: np.ndarray  # (V, 3)
    title: str
    frame: np.ndarray
    view: View = FRONT
    bar: "matplotlib.cm.ScalarMappable | None" = None
    ticks: Sequence[str] | None = None  # of a bar of classes 0, 1, ...


def _numpy(values: object) -> np.ndarray:
    """The array behind a tensor or anything array-like."""
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def _checked_maps(maps: object, n_from: int, n_to: int) -> np.ndarray:
    """``(G, n_from)`` vertex maps with entries in ``[0, n_to)``."""
    table = _numpy(maps)
    if table.ndim != 2 or table.shape[0] < 1 or table.shape[1] != n_from:
        raise ValueError(f"maps: given shape {table.shape}; allowed is (G, {n_from}) with G >= 1")
    if table.min() < 0 or table.max() >= n_to:
        raise ValueError(f"maps: given ids from {table.min()} to {table.max()}; allowed are 0 to {n_to - 1}")
    return table


def _checked_names(names: Sequence[Any] | np.ndarray | None, argument: str, count: int) -> None:
    """One entry per map, or none given."""
    if names is not None and len(names) != count:
        raise ValueError(f"{argument}: given {len(names)} entries; allowed is one per map, {count}")


def _paired_frames(source: Mesh, target: Mesh, maps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames of source and target that show corresponding sides.

    The rotation that fits a direct map best says which directions correspond. Of all pairs of up directions within 70
    degrees of each other under it the best-standing one is taken, equal ones with a bonus: shapes of one data set share
    their axes, and a rearing cat is not to be shown levelled.
    """
    x, y = source.verts.numpy(), target.verts.numpy()
    weight = source.vertex_areas.numpy()[:, None] / source.area
    x = x - (weight * x).sum(0)
    best, carry = -np.inf, np.eye(3)
    for row in maps:
        left, strength, right = np.linalg.svd((y[row] - (weight * y[row]).sum(0)).T @ (weight * x))
        turn = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
        strength, left = strength * turn, left * turn
        if strength.sum() > best:
            best, carry = float(strength.sum()), left @ right  # moves row vectors of the target onto the source's
    ways = np.concatenate([np.eye(3), -np.eye(3)])
    scores, scores_target = (up_scores(mesh).T.reshape(-1) for mesh in (source, target))
    total = (scores[:, None] + scores_target) * (1 + 0.5 * np.eye(6)) * (ways @ carry.T @ ways.T > 0.35)
    i, j = np.unravel_index(int(total.argmax()), (6, 6))
    if not (scores.any() and scores_target.any() and total[i, j] > 0):
        return auto_frame(source), auto_frame(target)
    frame = auto_frame(target, ways[j])
    front = frame[2] @ carry
    front = front - (front @ ways[i]) * ways[i]
    if np.linalg.norm(front) < 0.3:
        return auto_frame(source, ways[i]), frame
    front /= np.linalg.norm(front)
    return np.stack([np.cross(ways[i], front), ways[i], front]), frame


def _panel_figure(places: Sequence[tuple[float | int, int, _Panel]], title: str | None) -> "matplotlib.figure.Figure":
    """Panels at ``(row, column, panel)``, equally large, each shape at the scale of its own area."""
    boxes = []
    for _, _, panel in places:
        seen = project(panel.mesh, panel.view, panel.frame)[panel.mesh.referenced.numpy(), :2]
        boxes.append(((seen.min(0) + seen.max(0)) / 2, np.ptp(seen, axis=0) / panel.mesh.area**0.5))
    size = 1.06 * np.max([box for _, box in boxes], axis=0)
    size = np.maximum(size, size.max() / 3)
    rows, columns = ceil(max(row for row, _, _ in places)) + 1, max(column for _, column, _ in places) + 1
    area = PANEL_AREA * min(1.0, 8 / (rows * columns))  # square inches: many maps, smaller panels
    width, height = (size * (area / size.prod()) ** 0.5).tolist()
    bar = 0.42 if any(panel.bar for _, _, panel in places) else 0.0
    gap, head, top = 0.12, 0.30, 0.42 if title else 0.06
    cell = height + head + bar
    total = np.array([columns * (width + gap) + gap, rows * cell + top + 0.08])
    figure = new_figure(*total.tolist())

    def axes(left: float, bottom: float, wide: float, high: float) -> "matplotlib.axes.Axes":
        return figure.add_axes((left / total[0], bottom / total[1], wide / total[0], high / total[1]))

    if title:
        figure.text(0.5, 1 - 0.24 / total[1], title, ha="center", va="center", fontsize=12, weight="bold")
    for (row, column, panel), (centre, _) in zip(places, boxes, strict=True):
        left, bottom = gap + column * (width + gap), total[1] - top - (row + 1) * cell + bar
        ax = axes(left, bottom, width, height)
        render_mesh(ax, panel.mesh, panel.colors, view=panel.view, up=panel.frame)
        half = size * panel.mesh.area**0.5 / 2
        ax.set(xlim=(centre[0] - half[0], centre[0] + half[0]), ylim=(centre[1] - half[1], centre[1] + half[1]))
        ax.text(0.5, 1.02, panel.title, ha="center", va="bottom", fontsize=10, transform=ax.transAxes)
        if panel.bar:
            strip = axes(left + 0.15 * width, bottom - 0.16, 0.7 * width, 0.08)
            drawn = figure.colorbar(panel.bar, cax=strip, orientation="horizontal")
            if panel.ticks is None:
                strip.locator_params(nbins=4)
            else:
                drawn.set_ticks(range(len(panel.ticks)), labels=panel.ticks)
                strip.minorticks_off()
            strip.tick_params(labelsize=8, length=2, pad=2)
            strip.spines["outline"].set_linewidth(0.5)
    return figure


def match_figure(
    source: Mesh,
    target: Mesh,
    maps: Int[Tensor, "G V"] | Int[np.ndarray, "G V"],
    labels: Sequence[str] | np.ndarray,
    path: str | Path,
    scores: Sequence[float] | Shaped[Tensor, " S"] | np.ndarray | None = None,
    title: str | None = None,
) -> Path:
    """Draw all maps of a match: the target in XYZ colours, then the source in the colours that each map brings back.

    Both shapes are seen from corresponding sides, and from behind in a second row when there are at most two maps. Of
    more than 16 maps the first 16 are drawn, and the title says so.

    Args:
        source: the shape that is coloured, V_source vertices.
        target: the shape whose coordinates are the colours.
        maps: ``(G, V_source)`` target vertex of each source vertex.
        labels: G names, such as ``direct`` and ``mirrored``.
        path: the picture (its ending says the format; the folder is made if need be).
        scores: G numbers shown beside the labels.
        title: a line above the figure.

    Returns:
        ``path``.

    Raises:
        ValueError: if ``maps``, ``labels``, ``scores`` or ``path`` does not fit; the message names it.

    References:
        Ovsjanikov et al. 2013, Figures 1 and 11.
    """
    table = _checked_maps(maps, source.n_verts, target.n_verts)
    count = len(table)
    _checked_names(labels, "labels", count)
    _checked_names(None if scores is None else _numpy(scores), "scores", count)
    names = [str(label) for label in labels]
    if scores is not None:
        names = [f"{name} ({float(score):.3g})" for name, score in zip(names, _numpy(scores), strict=True)]
    if count > MAX_MAPS:
        title = f"{title + ': ' if title else ''}the first {MAX_MAPS} of {count} maps"
        table, names, count = table[:MAX_MAPS], names[:MAX_MAPS], MAX_MAPS
    direct = [g for g in range(count) if str(labels[g]) == "direct"]
    frame, frame_target = _paired_frames(source, target, table[direct] if direct else table)
    colors = xyz_colors(target)
    columns = count if count <= 4 else 3 if count <= 6 else 4
    rows = ceil(count / columns)
    places: list[tuple[float | int, int, _Panel]] = []
    for turn, view in enumerate((FRONT, FRONT.behind()) if count <= 2 else (FRONT,)):
        places.append(((rows - 1) / 2 + turn, 0, _Panel(target, colors, "" if turn else "target", frame_target, view)))
        for g, (row, name) in enumerate(zip(table, names, strict=True)):
            panel = _Panel(source, colors[row], "" if turn else name, frame, view)
            places.append((g // columns + turn, 1 + g % columns, panel))
    return save_figure(_panel_figure(places, title), path)


def _scalar_panel(mesh: Mesh, values: np.ndarray, name: str, frame: np.ndarray, zero: bool = False) -> _Panel:
    """A field with its colour bar: RGB as it is, few integers as classes, signed values centred at zero."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    if values.ndim == 2:
        return _Panel(mesh, to_rgb(values, mesh.n_verts), name, frame)
    if values.dtype.kind in "iub" and len(classes := np.unique(values)) <= len(CLASS_COLORS):
        cmap = ListedColormap(CLASS_COLORS[: len(classes)])
        ids = np.searchsorted(classes, values)
        bar = ScalarMappable(Normalize(-0.5, len(classes) - 0.5), cmap)
        return _Panel(mesh, cmap(ids)[:, :3], name, frame, bar=bar, ticks=[str(int(c)) for c in classes])
    finite = values[np.isfinite(values)].astype(np.float64)
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    signed = min(-low, high) > 0.2 * max(-low, high)  # a distance that rings a little below zero is not signed
    low, high = (-max(-low, high), max(-low, high)) if signed else (0.0 if zero else low, high)
    high = high if high > low else low + 1.0
    kind = "RdBu_r" if signed else "viridis"
    return _Panel(
        mesh,
        to_rgb(values, mesh.n_verts, kind, (low, high)),
        name,
        frame,
        bar=ScalarMappable(Normalize(low, high), kind),
    )


def symmetry_figure(
    mesh: Mesh,
    maps: Int[Tensor, "G V"] | Int[np.ndarray, "G V"],
    path: str | Path,
    labels: Sequence[str] | np.ndarray | None = None,
) -> Path:
    """Draw a shape's symmetries: its XYZ colours, those of each point's image, and for one reflection ``|x - S(x)|``.

    Args:
        mesh: the shape, V vertices.
        maps: ``(G, V)`` image of each vertex; identity rows are not drawn. Of more than 16 the first 16 are drawn.
        path: the picture.
        labels: G names of the maps.

    Returns:
        ``path``.

    Raises:
        ValueError: if ``maps``, ``labels`` or ``path`` does not fit.

    References:
        Ovsjanikov et al. 2013, Section 6.1, Figures 7 and 9.
    """
    table = _checked_maps(maps, mesh.n_verts, mesh.n_verts)
    _checked_names(labels, "labels", len(table))
    names = (
        [str(name) for name in labels] if labels is not None else [f"image under map {g}" for g in range(len(table))]
    )
    moving = [g for g in range(len(table)) if (table[g] != np.arange(mesh.n_verts)).any()]
    frame = auto_frame(mesh)
    colors = xyz_colors(mesh)
    panels = [_Panel(mesh, colors, "XYZ colours", frame)]
    panels += [_Panel(mesh, colors[table[g]], names[g], frame) for g in moving[:MAX_MAPS]]
    if len(moving) == 1:
        moved = (mesh.verts - mesh.verts[table[moving[0]]]).norm(dim=1).numpy() / mesh.area**0.5
        panels.append(_scalar_panel(mesh, moved, "|x − S(x)| / √area", frame, zero=True))
    title = f"the first {MAX_MAPS} of {len(moving)} maps" if len(moving) > MAX_MAPS else None
    return save_figure(_panel_figure(_in_rows(panels), title), path)


def scalar_figure(
    mesh: Mesh,
    fields: Mapping[str, Shaped[Tensor, "V *C"] | Shaped[np.ndarray, "V *C"]],
    path: str | Path,
    title: str | None = None,
) -> Path:
    """Draw fields on a shape side by side, each with its colour bar.

    Args:
        mesh: the shape, V vertices.
        fields: name to ``(V,)`` values, or to ``(V, 3)`` RGB in [0, 1]. Up to seven different integers (or
            booleans) are drawn as classes, fields of both signs in diverging colours around zero; NaN is neutral.
        path: the picture.
        title: a line above the figure.

    Returns:
        ``path``.

    Raises:
        ValueError: if a field or ``path`` does not fit, or there are no fields.

    References:
        Ovsjanikov et al. 2013, Figures 2 and 7.
    """
    arrays = {name: _numpy(field) for name, field in fields.items()}
    if not arrays:
        raise ValueError("fields: given none; allowed is at least one")
    for name, values in arrays.items():
        if values.shape not in ((mesh.n_verts,), (mesh.n_verts, 3)):
            allowed = f"({mesh.n_verts},) or ({mesh.n_verts}, 3)"
            raise ValueError(f"fields[{name!r}]: given shape {values.shape}; allowed is {allowed}")
    frame = auto_frame(mesh)
    panels = [_scalar_panel(mesh, values, name, frame) for name, values in arrays.items()]
    return save_figure(_panel_figure(_in_rows(panels), title), path)


def _in_rows(panels: Sequence[_Panel]) -> list[tuple[float | int, int, _Panel]]:
    """Panels in reading order, at most five a row and rows about equally long."""
    rows = ceil(len(panels) / 5)
    columns = ceil(len(panels) / rows)
    return [(i // columns, i % columns, panel) for i, panel in enumerate(panels)]
