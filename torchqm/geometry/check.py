"""What is wrong with a mesh: the counts behind every warning and error, and the repairs."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchqm.geometry.mesh import Mesh
from torchqm.geometry.topology import (
    component_areas,
    count_nonmanifold_verts,
    edge_table,
    equal_positions,
    face_masks,
    orient,
    triangle_shapes,
)

__all__ = [
    "DEGENERATE_HEIGHT",
    "EXTENTS",
    "MeshError",
    "MeshReport",
    "check_arrays",
    "check_mesh",
    "clean_faces",
    "inspect_mesh",
    "orient_faces",
    "weld",
]

DEGENERATE_HEIGHT = 1e-8
"""A triangle is degenerate when its height over its longest edge is at most this share of that edge.

Relative to the triangle itself, so no scale of the mesh changes the answer. ``1e-8`` is below the rounding of
coordinates kept in single precision (6e-8) and far above that of double precision."""


EXTENTS = (1e-60, 1e60)
"""Smallest and largest extent of a mesh that :func:`check_mesh` lets through, in units of its coordinates.

The norm of a triangle's normal needs fourth powers of lengths: between these, and for triangles up to ``1e-15`` of the
mesh in size, they stay within double precision (1e-308 to 1e308) whether or not a step scales the mesh first."""


_REPORT = "_report"  # where a mesh keeps its report, beside its cached properties


class MeshError(ValueError):
    """A mesh that cannot be used; the message names the file (or the mesh) and the fault."""


@dataclass(frozen=True)
class MeshReport:
    """Counts that describe a mesh; all but ``n_faces``, ``n_degenerate`` and ``n_repeated`` are of the cleaned faces.

    Args:
        label: the mesh's file or name.
        n_verts: vertices, unreferenced ones included.
        n_faces: triangles as given.
        euler: Euler characteristic, referenced vertices - edges + triangles.
        component_areas: area of each connected piece, largest first, in squared units of the coordinates (0 or infinite
            where that is beyond double precision).
        n_welded_components: how many pieces would be left after :func:`weld`.
        n_unreferenced: vertices that no triangle (with three different corners) uses.
        n_duplicate_verts: vertices whose position an earlier vertex has exactly.
        n_degenerate: triangles with a repeated corner, or flat by :data:`DEGENERATE_HEIGHT`.
        n_flat: those of them with three different corners (they stay in the cleaned faces).
        n_repeated: triangles with the same three corners as an earlier one.
        n_nonmanifold_edges: edges of three or more triangles.
        n_nonmanifold_verts: vertices whose triangles form more than one fan.
        n_boundary_edges: edges of one triangle.
        oriented: whether neighbouring triangles always turn the same way.
        min_angle: smallest angle of any triangle, in degrees.
        median_min_angle: median over triangles of their smallest angle, in degrees.
        sliver_share: share of the area in triangles with an angle below one degree.
        relative_area: total area over the square of the largest coordinate difference to vertex 0.
    """

    label: str
    n_verts: int
    n_faces: int
    euler: int
    component_areas: tuple[float, ...]
    n_welded_components: int
    n_unreferenced: int
    n_duplicate_verts: int
    n_degenerate: int
    n_flat: int
    n_repeated: int
    n_nonmanifold_edges: int
    n_nonmanifold_verts: int
    n_boundary_edges: int
    oriented: bool
    min_angle: float
    median_min_angle: float
    sliver_share: float
    relative_area: float

    @property
    def n_components(self) -> int:
        """Number of connected pieces of the cleaned faces."""
        return len(self.component_areas)

    @property
    def area(self) -> float:
        """Total area of the cleaned faces."""
        return sum(self.component_areas)

    @property
    def manifold(self) -> bool:
        """Whether every edge has at most two triangles and every vertex one fan of them."""
        return self.n_nonmanifold_edges == 0 and self.n_nonmanifold_verts == 0

    @property
    def closed(self) -> bool:
        """Whether no edge is on a boundary."""
        return self.n_boundary_edges == 0

    @property
    def warnings(self) -> list[str]:
        """One sentence for each thing that was handled but that the user should know."""
        welds = f"; welding equal positions would leave {self.n_welded_components}"
        rules = [
            (
                self.n_components > 1,
                f"{self.n_components} components{welds if self.n_welded_components < self.n_components else ''}",
            ),
            (
                self.n_unreferenced > 0,
                f"{self.n_unreferenced} of {self.n_verts} vertices belong to no triangle: "
                "they keep their ids and are left out of the operator",
            ),
            (
                self.n_duplicate_verts > 0,
                f"{self.n_duplicate_verts} vertices repeat the position of another vertex: "
                "kept as separate vertices (torchqm.geometry.weld joins them)",
            ),
            (
                self.n_degenerate > 0,
                f"{self.n_degenerate} of {self.n_faces} triangles are degenerate: "
                f"{self.n_degenerate - self.n_flat} with a repeated corner (dropped), {self.n_flat} flat (kept)",
            ),
            (self.n_repeated > 0, f"{self.n_repeated} of {self.n_faces} triangles repeat an earlier one: dropped"),
            (
                self.n_boundary_edges > 0,
                f"open surface with {self.n_boundary_edges} boundary edges: Neumann condition there",
            ),
            (
                not self.manifold,
                f"{self.n_nonmanifold_edges} non-manifold edges and {self.n_nonmanifold_verts} non-manifold vertices: "
                "robust Laplacian",
            ),
            (not self.oriented, "triangles are not consistently oriented"),
        ]
        return [f"{self.label}: {text}" for holds, text in rules if holds]


def check_arrays(verts: np.ndarray, faces: np.ndarray, label: str) -> None:
    """Raise if positions and faces cannot make a mesh at all.

    Args:
        verts: ``(V, 3)`` positions.
        faces: ``(F, 3)`` vertex ids, 0-based.
        label: the file or mesh that the message names.

    Raises:
        MeshError: no vertices, no faces, a NaN or infinite coordinate, or a vertex id that does not exist.

    Example:
        >>> check_arrays(np.zeros((3, 3)), np.array([[0, 1, 7]]), "a.off")
        Traceback (most recent call last):
        torchqm.geometry.check.MeshError: a.off: face 0 refers to vertex 7, but there are 3 vertices (0 to 2)
    """
    if len(verts) == 0:
        raise MeshError(f"{label}: no vertices")
    if len(faces) == 0:
        raise MeshError(f"{label}: no faces (a mesh with {len(verts)} vertices needs at least one triangle)")
    bad = ~np.isfinite(verts).all(1)
    if bad.any():
        first = int(bad.argmax())
        raise MeshError(
            f"{label}: {int(bad.sum())} of {len(verts)} vertices have NaN or infinite coordinates, the first is vertex "
            f"{first} with ({', '.join(f'{x:g}' for x in verts[first])})"
        )
    outside = (faces < 0) | (faces >= len(verts))
    if outside.any():
        face = int(outside.any(1).argmax())
        index = int(faces[face][outside[face]][0])
        raise MeshError(
            f"{label}: face {face} refers to vertex {index}, "
            f"but there are {len(verts)} vertices (0 to {len(verts) - 1})"
        )


def clean_faces(mesh: Mesh) -> Int[Tensor, "F2 3"]:
    """Triangles with three different corners, each set of corners once (the first stays, in the given order).

    Args:
        mesh: any mesh with valid vertex ids.

    Returns:
        ``(F', 3)`` vertex ids; the vertices are not renumbered.

    Example:
        >>> mesh = Mesh.from_arrays(np.eye(3), [[0, 1, 2], [1, 2, 0], [0, 0, 1]])
        >>> clean_faces(mesh).tolist()
        [[0, 1, 2]]
    """
    distinct, first = face_masks(mesh.numpy()[1])
    keep = distinct & first
    return mesh.faces if keep.all() else mesh.faces[torch.from_numpy(keep)]


def weld(mesh: Mesh) -> tuple[Mesh, Int[Tensor, " V"]]:
    """Join vertices at exactly equal positions, as along the texture seams that some exporters cut open.

    Args:
        mesh: any mesh.

    Returns:
        The mesh with each position once, in the order of first appearance (faces keep their order and may become
        degenerate), and ``(V,)`` the new id of each old vertex.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0.0]], [[0, 1, 2], [2, 3, 0]])
        >>> welded, index = weld(mesh)
        >>> welded.n_verts, index.tolist()
        (3, [0, 1, 2, 1])
    """
    representative = equal_positions(mesh.numpy()[0])
    first = np.unique(representative)
    index = torch.from_numpy(np.searchsorted(first, representative))
    return replace(mesh, verts=mesh.verts[torch.from_numpy(first)], faces=index[mesh.faces]), index


def orient_faces(mesh: Mesh) -> Int[Tensor, "F2 3"] | None:
    """Cleaned triangles, some of them turned over so that neighbours agree; ``None`` where that cannot be.

    Each component keeps the orientation that most of its triangles have. A sheet such as a Moebius strip has none.

    Args:
        mesh: any mesh; edges of three or more triangles are not used to compare neighbours.

    Returns:
        ``(F', 3)`` vertex ids, or ``None`` for a non-orientable surface.
    """
    oriented = orient(clean_faces(mesh).numpy(), mesh.n_verts)
    return None if oriented is None else torch.from_numpy(oriented)


def inspect_mesh(mesh: Mesh) -> MeshReport:
    """Count everything that can be odd about a mesh, without judging it.

    Args:
        mesh: any mesh with finite positions and valid vertex ids.

    Returns:
        The counts; ``.warnings`` puts them into sentences.

    Raises:
        MeshError: what :func:`check_arrays` raises, or coordinates whose difference is no double any more.

    The report stays with the mesh, as its areas do: whoever asks again gets the same one.

    Example:
        >>> report = inspect_mesh(Mesh.from_arrays(np.eye(3), [[0, 1, 2]]))
        >>> report.n_boundary_edges, report.euler, report.oriented
        (3, 1, True)
    """
    kept = mesh.__dict__.get(_REPORT)
    if kept is None:
        kept = mesh.__dict__[_REPORT] = _inspect(mesh)
    return kept


def _inspect(mesh: Mesh) -> MeshReport:
    verts, given = mesh.numpy()
    check_arrays(verts, given, mesh.label)
    distinct, first = face_masks(given)
    faces = given[distinct & first]
    with np.errstate(over="ignore"):
        scale = float(np.abs(verts - verts[0]).max()) or 1.0  # 1e+-200 must not overflow when squared
    if not np.isfinite(scale):
        _check_extent(mesh)
    area, height, angle = triangle_shapes((verts - verts[0]) / scale, faces)
    table = edge_table(faces, mesh.n_verts)
    referenced = np.zeros(mesh.n_verts, dtype=bool)
    referenced[faces] = True
    welded = equal_positions(verts)
    n_duplicate = int((welded != np.arange(mesh.n_verts)).sum())
    pieces = component_areas(mesh.n_verts, table.edges, faces, area)
    joined = component_areas(mesh.n_verts, welded[table.edges], welded[faces], area) if n_duplicate else pieces
    total = float(area.sum())
    with np.errstate(over="ignore"):
        areas = pieces * scale * scale
    angle = np.degrees(angle)
    n_flat = int((height <= DEGENERATE_HEIGHT).sum())
    return MeshReport(
        label=mesh.label,
        n_verts=mesh.n_verts,
        n_faces=mesh.n_faces,
        euler=int(referenced.sum()) - len(table.edges) + len(faces),
        component_areas=tuple(areas.tolist()),
        n_welded_components=len(joined),
        n_unreferenced=int((~referenced).sum()),
        n_duplicate_verts=n_duplicate,
        n_degenerate=int((~distinct).sum()) + n_flat,
        n_flat=n_flat,
        n_repeated=int((distinct & ~first).sum()),
        n_nonmanifold_edges=int((table.count > 2).sum()),
        n_nonmanifold_verts=count_nonmanifold_verts(faces, table, mesh.n_verts),
        n_boundary_edges=int((table.count == 1).sum()),
        oriented=table.oriented,
        min_angle=float(angle.min()) if len(angle) else 0.0,
        median_min_angle=float(np.median(angle)) if len(angle) else 0.0,
        sliver_share=float(area[angle < 1.0].sum()) / total if total > 0 else 0.0,
        relative_area=total,
    )


def check_mesh(mesh: Mesh) -> MeshReport:
    """Inspect a mesh and refuse what the method cannot work on.

    Args:
        mesh: any mesh.

    Returns:
        The report; what was merely handled is in ``.warnings``.

    Raises:
        MeshError: what :func:`check_arrays` raises, a mesh without area or in several pieces, or an extent outside
            :data:`EXTENTS`.
    """
    check_arrays(*mesh.numpy(), mesh.label)
    _check_extent(mesh)
    report = inspect_mesh(mesh)
    if not report.relative_area > 0 or report.n_degenerate + report.n_repeated == report.n_faces:
        raise MeshError(f"{report.label}: the surface has no area (all {report.n_faces} triangles are degenerate)")
    if report.n_components > 1:
        raise MeshError(f"{report.label}: {_describe_components(report)}")
    return report


def _check_extent(mesh: Mesh) -> None:
    """Refuse coordinates so small or large that areas and their squares would leave double precision."""
    used = mesh.verts[mesh.referenced]  # a stray vertex makes a mesh no larger, but it counts where all are scaled
    whole, surface = (float((x.amax(0) - x.amin(0)).max()) for x in (mesh.verts, used))  # may be infinite
    small = 0 < surface < EXTENTS[0]
    if not small and whole <= EXTENTS[1]:
        return
    extent = surface if small else whole
    raise MeshError(
        f"{mesh.label}: the coordinates are too {'small' if small else 'large'}: their extent is "
        f"{f'{extent:.3g}' if np.isfinite(extent) else 'more than 1.8e+308'}, allowed are {EXTENTS[0]:g} to "
        f"{EXTENTS[1]:g}; rescale the mesh (the maps do not depend on the unit of length)"
    )


def _describe_components(report: MeshReport) -> str:
    """The sentence about the pieces: how many, their areas and shares of the whole, and whether welding helps."""
    more = ", ..." if report.n_components > 5 else ""
    areas = ", ".join(f"{a:.3g}" for a in report.component_areas[:5]) + more
    shares = ", ".join(f"{100 * a / (report.area or 1.0):.3g}%" for a in report.component_areas[:5]) + more
    text = (
        f"{report.n_components} components with areas {areas} in squared units of the file ({shares} of the whole), "
        "but one connected surface is needed"
    )
    if report.n_welded_components < report.n_components:
        left = report.n_welded_components
        text += (
            f"; {report.n_duplicate_verts} vertices repeat the position of another, and welding them "
            f"(torchqm.geometry.weld) would leave {left} component{'s' if left > 1 else ''}"
        )
    return text
