"""``torchqm symmetry``: the symmetries of one mesh."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchqm.cli.console import Progress, format_table, print_seconds, print_warnings
from torchqm.cli.folder import staged_folder
from torchqm.cli.inputs import (
    MESH_HELP,
    add_cache,
    add_parameters,
    as_plain,
    fit_parameters,
    make_parameters,
    read_mesh,
    shape_faults,
)
from torchqm.cli.threads import add_threads

if TYPE_CHECKING:
    from torchqm.geometry import Mesh

__all__ = ["FILES", "add_parser", "run"]

FILES = ("symmetry.npz", "summary.json", "symmetry.png")

_DESCRIPTION = """\
Find the symmetries of a shape as vertex maps: from its own mirror planes if it stands in a
symmetric pose, else from its spectrum (no reference, no landmarks); or by transfer from a
reference, another pose of the same shape (section 6.1 of the paper)."""

_EPILOG = """\
files written to DIR (whole or not at all):
  symmetry.npz  maps (G, V) image of each vertex, row 0 the identity; labels; scores (0 for an
                isometry); fmaps (G, K, K) functional matrices. `torchqm match --symmetry` reads
                it. If no symmetry was found there is row 0 alone, and a warning that says why.
  summary.json  where the symmetry came from, residuals, parameters, warnings, seconds per step
  symmetry.png  the shape's XYZ as RGB, those of each point's image, and how far it moves"""


def add_parser(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "symmetry",
        help="the symmetries of one mesh",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("mesh", type=Path, metavar="MESH", help=MESH_HELP)
    parser.add_argument(
        "--reference", type=Path, metavar="REF", help="a pose of the same shape that has a mirror plane"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", default=Path("torchqm-symmetry"), help="default: %(default)s"
    )
    parser.add_argument(
        "--symmetry",
        choices=("auto", "extrinsic", "detect"),
        default="auto",
        help="without a reference. auto (default): mirror planes if they fit firmly, else from the spectrum; "
        "extrinsic: mirror planes alone; detect: spectrum alone",
    )
    parser.add_argument(
        "--method",
        choices=("quotient", "paper"),
        default="quotient",
        help="way of transfer. quotient (default): what measured best; paper: section 6.1",
    )
    parser.add_argument("--no-picture", action="store_true", help="do not draw symmetry.png")
    add_cache(parser)
    add_threads(parser)
    add_parameters(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Find the symmetry of a file and write the results."""
    with staged_folder(arguments.out, FILES) as stage, Progress() as progress:
        from torchqm.matching import find_symmetry
        from torchqm.matching.result import write_json

        parameters = make_parameters(arguments)
        seen: dict[Path, Mesh] = {}
        mesh = read_mesh(arguments.mesh, seen)
        reference = None if arguments.reference is None else read_mesh(arguments.reference, seen)
        parameters, notes = fit_parameters(parameters, seen.values(), arguments.k_max is not None)
        with progress.stage(0.9), shape_faults():
            result = find_symmetry(
                mesh,
                reference=reference,
                parameters=parameters,
                listener=progress.listener,
                cache_dir=arguments.cache,
                method=arguments.method,
                symmetry=arguments.symmetry,
            )
        result.warnings[:0] = notes
        result.save(stage / "symmetry.npz")
        if not arguments.no_picture:
            from torchqm.viz import symmetry_figure

            with progress.step("picture", 0.1):
                symmetry_figure(mesh, result.maps, stage / "symmetry.png", result.labels)
        result.seconds.update(progress.seconds)
        write_json(stage / "summary.json", {"arguments": as_plain(arguments), **result.summary()})
    rows = [
        [f"{number} {label if number else 'identity'}", f"{score:.4f}"]
        for number, (label, score) in enumerate(zip(result.labels, result.scores.tolist(), strict=True))
    ]
    print(format_table(["symmetry", "score"], rows))
    order = len(result.labels)
    group = f"group: {result.details['group']} ({order} element{'s' if order > 1 else ''}); "
    print(f"{group}found by: {result.origin}; score: how far from an isometry (0)\n")
    print_seconds(result.seconds)
    print()
    print_warnings(result.warnings)
    print(f"written: {', '.join(str(arguments.out / name) for name in FILES if (arguments.out / name).exists())}")
