"""``torchqm demo``: two built-in creatures, matched and measured against the exact truth."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchqm.cli.console import Progress, UserError, format_table, print_seconds, print_warnings
from torchqm.cli.folder import staged_folder
from torchqm.cli.inputs import METHODS, as_plain
from torchqm.cli.match import FILES, write_match
from torchqm.cli.threads import add_threads

if TYPE_CHECKING:
    from torchqm.data.synthetic import Creature
    from torchqm.matching import MatchResult

__all__ = ["add_parser", "run"]

_CREATURES = ("quadruped", "biped")
_POINTS = 100

_DESCRIPTION = """\
Match two built-in creatures and compare every map found with the exact truth. The source
is posed and has its own triangulation; the target stands in its rest pose, whose mirror
plane gives the symmetry that the source then gets by transfer. Nothing is downloaded."""

_EPILOG = """\
The table has one row a map: its label, its score, its mean geodesic error against the exact
map of that kind (direct or mirrored) in units of sqrt(area), and the share of points with an
error below 0.05. Files in DIR: match.npz, summary.json, match.png; see 'torchqm match --help'."""


def add_parser(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "demo",
        help="match two built-in creatures",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--out", type=Path, metavar="DIR", default=Path("torchqm-demo"), help="default: %(default)s")
    parser.add_argument("--creature", choices=_CREATURES, default=_CREATURES[0], help="default: %(default)s")
    parser.add_argument(
        "--n-verts", type=int, metavar="N", default=5000, help="vertices of each (default: %(default)s)"
    )
    parser.add_argument(
        "--seed", type=int, metavar="N", default=0, help="draws the body, the pose and the triangulation (default: 0)"
    )
    parser.add_argument(
        "--method", choices=METHODS, default="quotient", help="as in 'torchqm match' (default: quotient)"
    )
    add_threads(parser, 1)  # at this size a second thread gains little
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Match two creatures, measure the maps, write the results."""
    with staged_folder(arguments.out, FILES) as stage, Progress() as progress:
        with progress.step("building the creatures", 0.35):
            source, target = _creatures(arguments.creature, arguments.n_verts, arguments.seed)
        from torchqm.matching import match

        with progress.stage(0.35):
            result = match(source.mesh, target.mesh, method=arguments.method, listener=progress.listener)
        with progress.step("errors against the truth", 0.2):
            errors = _measure(result, source, target)
        write_match(stage, result, source.mesh, target.mesh, progress, as_plain(arguments), errors=errors)
    print(
        f"{source.mesh.name} ({source.mesh.n_verts} vertices) to {target.mesh.name} ({target.mesh.n_verts} vertices), "
        "different poses and triangulations\n"
    )
    rows = [
        [
            f"{number} {row['label']}",
            f"{score:.4f}",
            row["truth"],
            f"{row['mean']:.4f}",
            f"{100 * row['share_below_0.05']:.1f} %",
        ]
        for number, (row, score) in enumerate(zip(errors["maps"], result.scores.tolist(), strict=True))
    ]
    print(format_table(["map", "score", "compared with", "mean error", "below 0.05"], rows))
    print(
        f"error: geodesic distance to the exact image / sqrt(area), at {errors['points']} points; "
        "score: how far from an isometry (0)\n"
    )
    print_seconds(result.seconds)
    print()
    print_warnings(result.warnings)
    print(f"written: {', '.join(str(arguments.out / name) for name in FILES)}")


def _creatures(kind: str, n_verts: int, seed: int) -> tuple["Creature", "Creature"]:
    from torchqm.data.synthetic import creature

    try:
        source = creature(kind, n_verts, seed, pose=seed + 1, retriangulate=seed + 1)
        return source, creature(kind, n_verts, seed)
    except ValueError as error:  # its arguments are the user's
        raise UserError(str(error)) from error


def _measure(result: "MatchResult", source: "Creature", target: "Creature") -> dict[str, Any]:
    """Errors of each map against the exact map of its kind; of an unlabelled one against the better kind."""
    from torchqm.data.synthetic import exact_maps
    from torchqm.evaluate import SurfacePoints, TruthDistances, spread_points

    exact = exact_maps(source, target)
    at = spread_points(source.mesh, _POINTS)
    truth = SurfacePoints(exact.corners[:, at], exact.bary[:, at])
    distances = TruthDistances.build(target.mesh, truth)
    kinds = ["direct" if sign > 0 else "mirrored" for sign in source.orientation.tolist()]
    rows: list[dict[str, Any]] = []
    for label, row in zip(result.labels, result.maps, strict=True):
        errors = distances.errors(row[at], truth)  # (G, S)
        allowed = [g for g, kind in enumerate(kinds) if label in (kind, "unknown")]
        best = min(allowed, key=lambda g: float(errors[g].mean()))
        rows.append(
            {
                "label": label,
                "truth": kinds[best],
                "mean": float(errors[best].mean()),
                "share_below_0.05": float((errors[best] < 0.05).double().mean()),
                "max": float(errors[best].max()),
            }
        )
    return {"points": len(at), "unit": "sqrt(area) of the target", "geodesic": distances.method, "maps": rows}
