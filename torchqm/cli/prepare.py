"""``torchqm prepare``: the eigenpairs of every shape of a set, kept for later runs."""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchqm.cli.console import Progress, UserError, format_table, print_warnings
from torchqm.cli.processes import Failure, in_processes, usable_cores

if TYPE_CHECKING:
    from torchqm.data.base import ShapeSet
    from torchqm.geometry import Mesh
    from torchqm.spectral import CacheReport

__all__ = ["DEFAULT_K", "FOLDER", "add_parser", "run"]

DEFAULT_K = 200
"""Eigenfunctions that ``torchqm match`` uses by default."""

FOLDER = ".torchqm"
"""Name of the cache in the folder of the shapes, where no other place is given."""

_DESCRIPTION = """\
Compute the eigenfunctions of every shape of a folder and keep them, one file a shape, so
that later runs read them in a moment. Several processes work at once. What is already
there is not computed again: after a kill or an interruption the same command goes on."""

_EPILOG = f"""\
where the files go:
  --cache DIR, else the folder that the environment variable TORCHQM_CACHE names, else
  ROOT/{FOLDER}. A later command finds them with --cache DIR or TORCHQM_CACHE=DIR.

  A file belongs to the content of a mesh (its coordinates and triangles), not to its name,
  and one with more functions serves requests for fewer. It takes 8 bytes x vertices x K.
  The cache of diffusion-net (<sha1>_0.npz) is used where DIR holds one. A damaged file is
  computed anew and named in the table. Deleting DIR is always safe.

exit status: 0 all shapes are in the cache, 1 some failed (the table says why; the others
are done), 2 wrong input, 130 interrupted."""


_LOOKING = 0.05  # reading a mesh and its entry, as a share of the time of computing the entry


@dataclass(frozen=True)
class _Task:
    root: str
    name: str
    k: int
    k_given: bool
    kind: str
    folder: Path


@dataclass(frozen=True)
class _Row:
    """What became of a shape."""

    vertices: int
    functions: int
    kind: str
    what: str
    found: bool
    seconds: float
    warnings: tuple[str, ...]


def add_parser(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "prepare",
        help="compute and keep the eigenfunctions of all shapes of a folder",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "root", metavar="ROOT", help="the set of shapes, see 'torchqm data check --help': a folder, or 'synthetic:'"
    )
    parser.add_argument("--cache", type=Path, metavar="DIR", help="where to keep them (default: see below)")
    parser.add_argument(
        "--k",
        type=_count,
        metavar="K",
        default=None,
        help=f"eigenfunctions a shape (default {DEFAULT_K}, which 'torchqm match' uses, or half the vertices of a "
        "small shape; the methods paper and semi use 300)",
    )
    parser.add_argument(
        "--laplacian",
        choices=("auto", "cotan", "robust"),
        default="auto",
        help="auto (default, which 'torchqm match' uses): cotangent weights, or the robust Laplacian where a mesh "
        "needs it",
    )
    parser.add_argument(
        "--jobs", type=_count, metavar="N", default=None, help="processes of one thread each (default: all cores)"
    )
    parser.set_defaults(run=run, threads=None, default_threads=1)


def run(arguments: argparse.Namespace) -> int:
    """Fill the cache; 1 if a shape failed."""
    shapes = _shapes(arguments.root)
    folder = _writable(arguments)
    k = arguments.k or DEFAULT_K
    jobs = arguments.jobs or usable_cores()
    tasks = [_Task(arguments.root, n, k, arguments.k is not None, arguments.laplacian, folder) for n in shapes.names]
    sizes = [_size(shapes, name) for name in shapes.names]
    rows: list[_Row | Failure | None] = [None] * len(tasks)
    try:
        with Progress() as progress:
            _fill(rows, tasks, sizes, jobs, progress)
    except KeyboardInterrupt:
        done = sum(isinstance(row, _Row) for row in rows)
        print(
            f"torchqm: interrupted; {done} of {len(tasks)} shapes are in {folder}, the same command goes on from there",
            file=sys.stderr,
        )
        return 130
    return _report(shapes, rows, folder)


def _size(shapes: "ShapeSet", name: str) -> int:
    """What the work for a shape goes with: the bytes of its file."""
    path = shapes.path(name)
    return 1 if path is None or not path.is_file() else max(path.stat().st_size, 1)


def _fill(
    rows: list[_Row | Failure | None],
    tasks: Sequence[_Task],
    sizes: Sequence[int],
    jobs: int,
    progress: Progress,
) -> None:
    """Do all tasks and put what comes of each into its row.

    Looking for an entry is counted as a small part of the work of making it; what is found in the cache drops out of
    the work that is left, so that the time left is that of the shapes to be computed.
    """
    looked, made, work = 0.0, 0, sum(sizes) * (1 + _LOOKING)
    progress.listener(f"0 of {len(tasks)} shapes", -1.0, 0.0)
    for count, (number, row) in enumerate(in_processes(_compute, tasks, jobs), 1):
        rows[number] = row
        looked += _LOOKING * sizes[number]
        if isinstance(row, _Row) and row.found:
            work -= sizes[number]
        else:
            made += sizes[number]
            name, spent = tasks[number].name, row.seconds if isinstance(row, _Row) else 0.0
            progress.listener(name if isinstance(row, _Row) else f"{name} failed", spent, (looked + made) / work)
        progress.listener(f"{count} of {len(tasks)} shapes", -1.0, (looked + made) / work)


def _compute(task: _Task) -> _Row:
    """Make the entry of a shape, if it is not there."""
    from torchqm.spectral import cached_basis

    mesh, k = _read(task)
    basis = cached_basis(mesh, k, task.kind, task.folder, whole_clusters=False, warn=False)
    report = basis.report
    if report.path is None:
        raise OSError(report.problems[-1])
    found = report.outcome == "read"
    return _Row(mesh.n_verts, basis.k, report.kind, _what(report), found, report.seconds, report.problems)


def _what(report: "CacheReport") -> str:
    words = {"read": "in the cache", "rebuilt": "computed in place of a damaged entry"}
    text = words.get(report.outcome, report.outcome)
    if report.outcome == "diffusion-net":
        text = f"taken from {report.source}"
    return "; ".join([text, *report.notes])


def _read(task: _Task) -> "tuple[Mesh, int]":
    """The mesh, and the number of functions: as in ``torchqm match``, half the vertices of a small one."""
    mesh = _shapes(task.root).mesh(task.name)
    usable = int((mesh.normalized().vertex_areas > 0).sum())
    if task.k_given or usable // 2 >= task.k:
        return mesh, task.k
    return mesh, max(min(30, task.k), usable // 2)


@lru_cache(maxsize=1)
def _shapes(root: str) -> "ShapeSet":
    """The set of shapes; each process opens it once."""
    from torchqm.data.layouts import open_shapes

    try:
        return open_shapes(root)
    except ValueError as error:
        raise UserError(str(error)) from error


def _writable(arguments: argparse.Namespace) -> Path:
    """The folder of the cache, made, and known to take files before hours of work."""
    from torchqm.spectral import cache_folder

    inside = Path(arguments.root) / FOLDER if Path(arguments.root).is_dir() else None
    folder = cache_folder(arguments.cache, inside)
    if folder is None:
        raise UserError(f"{arguments.root}: is no folder, so say where the cache goes: --cache DIR, or TORCHQM_CACHE")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(
            f"{folder}: the cache cannot be made there ({error.strerror or error}); "
            "another place is given by --cache DIR or TORCHQM_CACHE"
        ) from error
    return folder


def _report(shapes: "ShapeSet", rows: list[_Row | Failure | None], folder: Path) -> int:
    """The table of all shapes, and what it comes to."""
    cells, texts = [], []
    excluded, unreadable = (getattr(shapes, name, {}) for name in ("excluded", "unreadable"))
    problems = [f"{name} is left out: {why}" for name, why in excluded.items()]
    for name, row in zip(shapes.names, rows, strict=True):
        if isinstance(row, _Row):
            cells.append([name, str(row.vertices), str(row.functions), row.kind, f"{row.seconds:.2f}"])
            texts.append(row.what)
            problems += row.warnings
        else:
            cells.append([name, "-", "-", "-", "-"])
            texts.append(f"failed: {row.reason if row else 'not looked at'}")
    table = format_table(["shape", "vertices", "functions", "Laplacian", "seconds"], cells).splitlines()
    print("\n".join(f"{line}  {text}".rstrip() for line, text in zip(table, ["", *texts], strict=True)))
    counts = Counter("failed" if text.startswith("failed") else text.split(";")[0].split(",")[0] for text in texts)
    size = sum(file.stat().st_size for file in folder.glob("*.npz")) / 2**20
    print(f"\n{len(rows)} shapes: " + ", ".join(f"{count} {text}" for text, count in counts.items()))
    print(f"cache: {folder} ({size:.0f} MiB); for later commands: --cache {folder}, or TORCHQM_CACHE={folder}")
    print_warnings(problems)
    return 1 if counts["failed"] or unreadable else 0


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: at least 1")
    return value
