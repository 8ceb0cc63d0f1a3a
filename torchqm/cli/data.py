"""``torchqm data``: what a set of shapes holds."""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from torchqm.cli.console import UserError

if TYPE_CHECKING:
    from torchqm.data.base import Problem, ShapeSet

__all__ = ["add_parser", "run_check"]

_MOST_ROWS = 30  # of each kind of problem; --json has all

_DESCRIPTION = """\
Look through a set of shapes: what layout it has and why that is believed, from what number
its ids count, what it holds of each class, what is missing and what is malformed (vertex
count against class, ids out of range, unreadable or truncated files)."""

_EPILOG = """\
layouts that are recognised:
{layouts}

Exit status: 0 if nothing is missing or malformed (notes do not count), 1 if something is,
2 if there is no such folder or its layout is unknown."""

_LAYOUTS = """\
  scb                  TOSCA/Meshes/*.off, TOSCA/Corrs, Results (Kim et al. 2011)
  tosca-mat            cat0.mat with surface.X, Y, Z, TRIV
  tosca-vert           cat0.vert with cat0.tri
  vts                  off + corres (ULRSSM), shapes + correspondences (AttentiveFMaps),
                       off_2 + corres (diffusion-net): FAUST_r, SCAPE_r, with .sym.vts
  faust-registrations  tr_reg_000.ply, also in training/registrations
  smal, dt4d           as vts, with train.txt and test.txt
  shrec19              as vts, with corres/i_j.map (shape 40 is left out)
  shrec16              null + cuts or holes, .baryc_gt and .baryc_gt_sym
  shrec07              381.off + 381.vts, landmarks
  plain                any meshes, and pairs.txt if there is one
  synthetic:           the built-in creatures"""


def add_parser(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("data", help="look through a set of shapes", allow_abbrev=False)
    actions = parser.add_subparsers(metavar="ACTION", dest="action", required=True)
    check = actions.add_parser(
        "check",
        help="what is there, what is missing, what is malformed",
        description=_DESCRIPTION,
        epilog=_EPILOG.format(layouts=_LAYOUTS),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    check.add_argument("root", metavar="ROOT", help="folder of the set, or 'synthetic:'")
    check.add_argument("--json", action="store_true", help="print the same as JSON")
    check.add_argument(
        "--full",
        action="store_true",
        help="read every number of every mesh; without it, an OFF file is believed that has as many lines as its "
        "header says and nothing but numbers in them",
    )
    check.set_defaults(run=run_check, threads=None, default_threads=1)


def run_check(arguments: argparse.Namespace) -> int:
    """Check a set and print what was found.

    Returns:
        0 if nothing is missing or malformed, else 1.

    Raises:
        UserError: no such folder, or an unknown layout.
    """
    from torchqm.data.base import LayoutError
    from torchqm.data.layouts import open_shapes

    try:
        shapes = open_shapes(arguments.root)
    except LayoutError as error:
        raise UserError(str(error)) from error
    problems = _problems(shapes, arguments.full)
    faults = [problem for problem in problems if problem.severity != "note"]
    report = {
        "root": str(shapes.root),
        "layout": shapes.layout,
        "recognised": shapes.recognised,
        "shapes": len(shapes.names),
        "classes": [_class_row(shapes, cls) for cls in shapes.classes],
        "published_pairs": _count_pairs(shapes),
        "split": {part: len(names) for part, names in (shapes.split() or {}).items()},
        "problems": [asdict(problem) for problem in problems],
        "ok": not faults,
    }
    if arguments.json:
        print(json.dumps(report, indent=2, default=str))
    else:
        _print_report(report, problems)
    return 1 if faults else 0


def _problems(shapes: "ShapeSet", full: bool) -> "list[Problem]":
    from torchqm.data.folder import FolderShapes

    found = shapes.problems(full) if isinstance(shapes, FolderShapes) else shapes.problems()
    order = ("malformed", "missing", "note")
    return sorted(found, key=lambda problem: order.index(problem.severity))


def _class_row(shapes: "ShapeSet", cls: str) -> dict[str, Any]:
    names = [name for name in shapes.names if shapes.shape_class(name) == cls]
    counts = []
    for name in names:
        if shapes.path(name) is None:  # made on demand, which takes seconds each
            continue
        try:
            counts.append(shapes.n_verts(name))
        except ValueError:  # the mesh cannot be read: it is among the problems
            continue
    truth, symmetry = shapes.about(cls)
    vertices = [min(counts), max(counts)] if counts else []
    return {"name": cls, "shapes": len(names), "vertices": vertices, "truth": truth, "symmetry": symmetry}


def _count_pairs(shapes: "ShapeSet") -> int | None:
    """How many pairs are published; None if the list cannot be used (which is among the problems)."""
    try:
        return len(shapes.published_pairs())
    except ValueError:
        return None


def _print_report(report: dict[str, Any], problems: "Sequence[Problem]") -> None:
    print(f"{report['root']}: layout {report['layout']}")
    for sentence in report["recognised"]:
        print(f"  {sentence}")
    print()
    rows = [
        [row["name"], str(row["shapes"]), _range(row["vertices"]), row["truth"], row["symmetry"]]
        for row in report["classes"]
    ]
    print(_table([["class", "shapes", "vertices", "truth", "symmetry"], *rows], numbers=(1, 2)))
    print()
    if problems:
        print(_problem_table(problems))
        print()
    counts = {kind: sum(problem.severity == kind for problem in problems) for kind in ("malformed", "missing", "note")}
    parts = "".join(f", {part} {count}" for part, count in report["split"].items())
    pairs = f", {report['published_pairs']} published pairs" if report["published_pairs"] else ""
    amount = f"{_count(report['shapes'], 'shape')} in {_count(len(report['classes']), 'class', 'classes')}"
    print(f"{amount}{pairs}{parts}")
    print(f"{counts['malformed']} malformed, {counts['missing']} missing, {_count(counts['note'], 'note')}")


def _count(number: int, one: str, many: str | None = None) -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def _range(counts: list[int]) -> str:
    if not counts:  # no mesh could be read, or they are made on demand
        return "-"
    return str(counts[0]) if counts[0] == counts[1] else f"{counts[0]}-{counts[1]}"


def _problem_table(problems: "Sequence[Problem]") -> str:
    """Of each kind of problem the first rows."""
    rows = [["problem", "name", "what"]]
    for kind in ("malformed", "missing", "note"):
        these = [problem for problem in problems if problem.severity == kind]
        rows += [[kind, problem.name, problem.what] for problem in these[:_MOST_ROWS]]
        if len(these) > _MOST_ROWS:
            rows.append([kind, "...", f"and {len(these) - _MOST_ROWS} more (--json has all)"])
    return _table(rows)


def _table(rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Columns two blanks apart, to the left but for those of numbers; the last is as long as it is.

    Example:
        >>> print(_table([["class", "shapes", "truth"], ["cat", "11", "same vertex ids"]], numbers=(1,)))
        class  shapes  truth
        cat        11  same vertex ids
    """
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]

    def cell(column: int, text: str) -> str:
        return text.rjust(widths[column]) if column in numbers else text.ljust(widths[column])

    lines = ("  ".join(cell(column, text) for column, text in enumerate(row)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)
