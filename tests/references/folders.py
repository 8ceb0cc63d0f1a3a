"""Tiny hand-made folders in the layouts of the field's data sets."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from torchqm.geometry import Mesh, save_mesh


def strip(n_verts: int) -> Mesh:
    """A strip of ``n_verts - 2`` triangles."""
    i = np.arange(n_verts)
    verts = np.stack([i, i % 2, 0.1 * (i % 3)], 1).astype(float)
    return Mesh.from_arrays(verts, np.stack([i[:-2], i[1:-1], i[2:]], 1), "strip")


def write_mesh(path: Path, n_verts: int = 6, base: int = 1) -> None:
    """A strip in the format of the ending; ``base`` is that of the triangles of ``.mat`` and ``.vert``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh = strip(n_verts)
    verts, faces = mesh.numpy()
    if path.suffix == ".mat":
        from scipy.io import savemat

        x, y, z = verts.T[:, :, None]
        savemat(path, {"surface": {"X": x, "Y": y, "Z": z, "TRIV": faces + base}})
    elif path.suffix == ".vert":
        np.savetxt(path, verts)
        np.savetxt(path.with_suffix(".tri"), faces + base, fmt="%d")
    else:
        save_mesh(mesh, path)


def write_lines(path: Path, lines: Iterable[object]) -> None:
    """One entry a line; a sequence becomes numbers with blanks between them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    words = (line if isinstance(line, Sequence) and not isinstance(line, str) else [line] for line in lines)
    rows = (" ".join(map(str, row)) for row in words)
    path.write_text("\n".join(rows) + "\n")


def found(shapes, severity: str | None = None, **options: bool) -> dict[str, str]:
    """What the check says, by name; of one severity, or all."""
    return {p.name: p.what for p in shapes.problems(**options) if severity in (None, p.severity)}
