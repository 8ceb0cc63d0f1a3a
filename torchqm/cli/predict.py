"""``torchqm predict``: the maps of many pairs by a trained network, gone on with after a kill; no truth is needed."""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchqm.cli.checkpoint import CHECKPOINT_HELP, read_checkpoint
from torchqm.cli.config_file import add_config
from torchqm.cli.console import Progress, UserError, print_warnings
from torchqm.cli.inputs import add_cache, add_parameters, as_plain, fit_parameters, make_parameters
from torchqm.cli.threads import add_threads

if TYPE_CHECKING:
    from torchqm.data.base import ShapeSet
    from torchqm.learn import LearnedDescriptors
    from torchqm.matching import MatchParameters, MatchResult

__all__ = ["add_parser", "run"]

ABOUT = "predict.json"

_DESCRIPTION = """\
Match the pairs of a set of shapes with learned descriptors, and write all the equally good
maps of each pair. Nothing but the shapes is needed. After a kill or an interruption the same
command goes on; a pair that fails leaves a line on stderr, and is tried again next time."""

_EPILOG = """\
files written to DIR:
  A+B.npz       of each pair, as match.npz of 'torchqm match': maps (G, V_A), labels, ...
  predict.json  the network, parameters and set that all of these belong to

exit status: 0 all pairs are there, 1 some failed, 2 wrong input, 130 interrupted."""


def add_parser(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "predict",
        help="the maps of many pairs by a trained network",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(  # a default would take the place of what a file gives
        "root", metavar="ROOT", nargs="?", default=argparse.SUPPRESS, help="the set of shapes, see 'torchqm data check'"
    )
    add_config(parser)
    parser.add_argument("--checkpoint", metavar="RUN|FILE|builtin", help=f"needed: {CHECKPOINT_HELP}")
    parser.add_argument(
        "--pairs", default="within-class", metavar="SPEC", help="see 'torchqm benchmark --help' (default %(default)s)"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", default=Path("torchqm-predict"), help="default: %(default)s")
    add_cache(parser)
    add_threads(parser)
    add_parameters(parser)
    parser.set_defaults(run=run, method="quotient")


def run(arguments: argparse.Namespace) -> int:
    """Match what is missing; 1 if a pair failed."""
    from torchqm.benchmark.ledger import file_name
    from torchqm.data import choose_pairs, open_shapes

    for name, value in (("ROOT", getattr(arguments, "root", None)), ("--checkpoint", arguments.checkpoint)):
        if value is None:
            raise UserError(f"{name}: not given, but needed")
    parameters, descriptors = make_parameters(arguments), read_checkpoint(arguments.checkpoint)
    assert descriptors is not None
    try:
        shapes = open_shapes(arguments.root)
        pairs = choose_pairs(shapes, arguments.pairs)
    except (ValueError, FileNotFoundError) as error:
        raise UserError(str(error)) from error
    out: Path = arguments.out
    _begin(out, {"descriptors": repr(descriptors), "root": arguments.root}, parameters, as_plain(arguments))
    files = [out / f"{file_name(*pair)}.npz" for pair in pairs]
    todo = [(pair, path) for pair, path in zip(pairs, files, strict=True) if not path.exists()]
    print(f"{shapes.recognised[0]}; {len(pairs)} pairs, {len(pairs) - len(todo)} of them are there")
    faults: list[str] = []
    try:
        with Progress() as progress:
            for number, (pair, path, result) in enumerate(
                _matched(todo, shapes, parameters, descriptors, arguments), 1
            ):
                if isinstance(result, str):
                    faults.append(f"{pair[0]} → {pair[1]}: {result}")
                    continue
                try:
                    result.save(path)
                except OSError as error:
                    raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
                progress.listener(f"{pair[0]} → {pair[1]}", sum(result.seconds.values()), number / len(todo))
    except KeyboardInterrupt:
        print("torchqm: interrupted; the same command goes on", file=sys.stderr)
        return 130
    print_warnings(faults)
    print(f"{sum(path.exists() for path in files)} of {len(files)} pairs are in {out}")
    return 1 if faults else 0


def _matched(
    todo: list[tuple[tuple[str, str], Path]],
    shapes: "ShapeSet",
    parameters: "MatchParameters",
    descriptors: "LearnedDescriptors",
    arguments: argparse.Namespace,
) -> Iterator[tuple[tuple[str, str], Path, "MatchResult | str"]]:
    """The result of each pair, or why there is none."""
    from torchqm.matching import Collection

    # What was found of a source serves all its pairs; kept of all shapes together it would fill the memory.
    held: tuple[str, MatchParameters, Collection] | None = None
    for pair, path in todo:
        try:
            meshes = [shapes.mesh(name) for name in pair]
            own, _ = fit_parameters(parameters, meshes, arguments.k_max is not None)
            if held is None or held[:2] != (pair[0], own):
                held = pair[0], own, Collection(parameters=own, cache_dir=arguments.cache, descriptors=descriptors)
            result: MatchResult | str = held[2].match(meshes[0], meshes[1])
        except (UserError, ValueError, OSError) as error:  # of this pair alone
            result = " ".join(str(error).split())
        yield pair, path, result


def _begin(out: Path, same: dict[str, Any], parameters: "MatchParameters", arguments: dict[str, Any]) -> None:
    """Make the folder, or see that what is in it was made in the same way.

    Raises:
        UserError: it holds maps of another network, set or parameters, or cannot be used.
    """
    from torchqm.matching.result import write_json
    from torchqm.version import __version__

    wanted = {**same, "parameters": parameters.as_dict(), "version": __version__}
    path = out / ABOUT
    try:
        out.mkdir(parents=True, exist_ok=True)
        if path.exists():
            found = json.loads(path.read_text("utf-8"))
            other = [name for name in wanted if found.get(name) != wanted[name]]
            if other:
                raise UserError(f"{out}: holds maps of other {', '.join(other)} ({ABOUT}); choose another folder")
        else:
            write_json(path, {**wanted, "arguments": arguments})
    except (OSError, ValueError, AttributeError) as error:
        raise UserError(f"{path}: cannot be used ({' '.join(str(error).split())})") from error
