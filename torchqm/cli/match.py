"""``torchqm match``: all the equally good maps between two meshes."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchqm.cli.checkpoint import add_checkpoint, read_checkpoint
from torchqm.cli.console import Progress, UserError, format_table, print_seconds, print_warnings
from torchqm.cli.folder import staged_folder
from torchqm.cli.inputs import (
    MESH_HELP,
    METHODS,
    add_cache,
    add_parameters,
    as_plain,
    fit_parameters,
    make_parameters,
    read_mesh,
    read_symmetry,
    shape_faults,
)
from torchqm.cli.threads import add_threads

if TYPE_CHECKING:
    from torchqm.geometry import Mesh
    from torchqm.matching import MatchResult

__all__ = ["FILES", "add_parser", "print_match", "run", "write_match"]

FILES = ("match.npz", "summary.json", "match.png")

_DESCRIPTION = """\
Find all the equally good dense maps from SOURCE to TARGET, one for each symmetry of the
shape: each source vertex gets a vertex of the target in every map. The two meshes may
have different triangulations and vertex counts; they should be (nearly) isometric."""

_EPILOG = """\
where the symmetry comes from:
  By default a mirror plane is looked for in the reference if one is given, else in both
  shapes; a shape without plane gets its symmetry by transfer from one that has it (sections
  5 and 6.1 of the paper). If neither has one, each is asked its own spectrum. If no symmetry
  is found, one map comes back, with a warning.

files written to DIR (whole or not at all):
  match.npz     maps (G, V_source) target vertex of each source vertex; labels (direct: keeps
                orientation, mirrored: turns it over, unknown); scores (0 for an isometry);
                orbits (V_source, G); fmaps, fmap_even; symmetry_source, symmetry_target;
                orientation. Ids count from 0. Loads with numpy.load(allow_pickle=False).
  summary.json  parameters, versions, warnings, seconds per step
  match.png     the target's XYZ as RGB, carried over to the source by each map"""


def add_parser(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "match",
        help="all the equally good maps between two meshes",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("source", type=Path, metavar="SOURCE", help=f"the mesh to map from: {MESH_HELP}")
    parser.add_argument("target", type=Path, metavar="TARGET", help="the mesh to map to")
    parser.add_argument("--out", type=Path, metavar="DIR", default=Path("torchqm-match"), help="default: %(default)s")
    parser.add_argument(
        "--symmetry",
        default="auto",
        metavar="auto|extrinsic|detect|none|FILE",
        help="symmetry of the shapes. auto (default): see below; extrinsic: mirror planes alone; detect: "
        "spectra alone; none: use no symmetry; FILE: that of the target, a symmetry.npz, or .npy, .txt or .vts "
        "with the vertex that each vertex is mirrored to",
    )
    parser.add_argument("--symmetry-source", type=Path, metavar="FILE", help="symmetry of the source, if it is known")
    parser.add_argument(
        "--reference", type=Path, metavar="MESH", help="a pose of the same shape that has a mirror plane"
    )
    parser.add_argument(
        "--method",
        choices=METHODS,
        default="quotient",
        help="quotient (default): what measured best; paper: sections 4 to 7, its parameters; semi: section 5 alone",
    )
    parser.add_argument("--no-picture", action="store_true", help="do not draw match.png")
    add_checkpoint(parser)
    add_cache(parser)
    add_threads(parser)
    add_parameters(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Match two files and write the results."""
    if arguments.checkpoint is not None and arguments.descriptor is not None:
        raise UserError(f"--checkpoint takes the place of --descriptor {arguments.descriptor}; give one of the two")
    if arguments.symmetry == "none" and arguments.symmetry_source is not None:
        raise UserError("--symmetry none uses no symmetry, so --symmetry-source cannot be given with it")
    with staged_folder(arguments.out, FILES) as stage, Progress() as progress:
        from torchqm.matching import match
        from torchqm.matching.collection import SYMMETRIES

        parameters = make_parameters(arguments)
        descriptors = read_checkpoint(arguments.checkpoint)
        seen: dict[Path, Mesh] = {}
        source, target = read_mesh(arguments.source, seen), read_mesh(arguments.target, seen)
        reference = None if arguments.reference is None else read_mesh(arguments.reference, seen)
        parameters, notes = fit_parameters(parameters, seen.values(), arguments.k_max is not None)
        symmetry: Any = arguments.symmetry
        if symmetry not in SYMMETRIES:
            if not Path(symmetry).exists():
                raise UserError(f"{symmetry}: no such file; --symmetry is {', '.join(SYMMETRIES)} or a file")
            symmetry, more = read_symmetry(Path(symmetry), target)
            notes += more
        symmetry_source = None
        if arguments.symmetry_source is not None:
            symmetry_source, more = read_symmetry(arguments.symmetry_source, source)
            notes += more
        with progress.stage(0.9), shape_faults():
            result = match(
                source,
                target,
                symmetry=symmetry,
                symmetry_source=symmetry_source,
                reference=reference,
                method=arguments.method,
                parameters=parameters,
                listener=progress.listener,
                cache_dir=arguments.cache,
                descriptors=descriptors,
            )
        result.warnings[:0] = notes
        write_match(stage, result, source, target, progress, as_plain(arguments), not arguments.no_picture)
    print_match(result)
    print_warnings(result.warnings)
    print(f"written: {', '.join(str(arguments.out / name) for name in FILES if (arguments.out / name).exists())}")


def write_match(
    folder: Path,
    result: "MatchResult",
    source: "Mesh",
    target: "Mesh",
    progress: Progress,
    arguments: dict[str, Any],
    picture: bool = True,
    **more: Any,
) -> None:
    """Write ``match.npz``, ``match.png`` and, last since it holds the seconds of all, ``summary.json``."""
    from torchqm.matching.result import write_json

    result.save(folder / "match.npz")
    if picture:
        from torchqm.viz import match_figure

        with progress.step("picture", 0.1):
            path = folder / "match.png"
            match_figure(source, target, result.maps, result.labels, path, title=f"{source.name} to {target.name}")
    result.seconds.update(progress.seconds)
    write_json(folder / "summary.json", {"arguments": arguments, **result.summary(), **more})


def print_match(result: "MatchResult") -> None:
    """The maps and the seconds as tables."""
    rows = [
        [f"{number} {label}", f"{score:.4f}", f"{agreement:+.2f}"]
        for number, (label, score, agreement) in enumerate(
            zip(result.labels, result.scores.tolist(), result.orientation.tolist(), strict=True)
        )
    ]
    print(format_table(["map", "score", "orientation"], rows))
    print("score: how far the map is from an isometry (0); orientation: +1 keeps it everywhere, -1 turns it over\n")
    print_seconds(result.seconds)
    print()
