"""The options of ``torchqm benchmark``, and what its ``--help`` says."""

import argparse
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchqm.catalogue import DESCRIPTIONS, PAIRS_HELP, PUBLISHED_METHODS
from torchqm.cli.backends import add_backend

__all__ = ["DEFAULT_METHODS", "DESCRIPTION", "Help", "add_options"]

DEFAULT_METHODS = "quotient,zoomout,fmap,descriptors"

DESCRIPTION = """\
Run methods on pairs of a set of shapes and compare them: a table, the error curves of the
paper's figures, and pictures of the worst pairs. Each pair and method is a file of its own
in OUT/results, so after a kill or an interruption the same command goes on, and more
methods or pairs can be added later. A pair that fails is a row with its reason."""

_EPILOG = """\
methods:
{methods}
  learned:RUN              quotient with the descriptors of a trained network: a run folder,
                           a .ckpt, a .safetensors of 'torchqm export', or 'builtin'
  published:NAME           others' results in the set's own files (SCB): {published}

pairs:
  {pairs}

files written to OUT:
  results/METHOD-DIGEST/A+B.json   one pair: numbers, error of each point, seconds, notes; the
                  map is beside it (A+B.map.npz, p2p: target vertex of each source vertex).
                  Results of other options or versions are in folders of their own and never
                  mixed with these. A.json: the symmetry that a method found of a shape.
  symmetries      symmetries found on the way, each once for all pairs
  pairs.csv       all numbers, a row for each pair and method
  table.md        means over the pairs
  figure6_orbit, figure8_symmetry, figure10_map, figure_plain (.png and .svg)
  worst.html      pictures of the worst pairs of each method
  run.json        the commands that wrote results here: when, where, versions, machine

backends: tasks are run in processes of this machine, or by --backend dask --address
tcp://HOST:PORT on the workers of a Dask cluster (pip install 'torchqm[distributed]'), one at
a time in each worker process, so start workers of one thread ('dask worker ADDRESS
--nthreads 1 --nworkers N'). They need the same torchqm and must see ROOT and OUT under the
same paths. Tasks of a worker that dies are given to others, and nothing that is done is
done again; a task that each worker dies of is a row with that reason. After Ctrl-C workers
end the pairs they are at.

seconds: of the method itself, symmetries included (column seconds_symmetry: their part, which
is spent once a shape), eigenfunctions not.

exit status: 0 all pairs done, 1 some failed (the table says why), 2 wrong input,
130 interrupted."""


class Help(argparse.Action):
    """``--help`` with the names of all methods."""

    def __init__(self, option_strings: Sequence[str], dest: str, **_: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help="show this help and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print the help and stop."""
        methods = "\n".join(f"  {name:24} {text}" for name, text in DESCRIPTIONS.items())
        pairs = "\n  ".join(textwrap.wrap(PAIRS_HELP, 88))
        parser.epilog = _EPILOG.format(methods=methods, published=", ".join(PUBLISHED_METHODS), pairs=pairs)
        parser.print_help()
        parser.exit()


def add_options(parser: argparse.ArgumentParser) -> None:
    """All options of the command."""
    parser.add_argument("-h", "--help", action=Help)
    parser.add_argument(
        "root", metavar="ROOT", help="the set of shapes, see 'torchqm data check --help': a folder, or 'synthetic:'"
    )
    parser.add_argument(
        "--methods", default=DEFAULT_METHODS, metavar="A,B,...", help="which methods, see below (default %(default)s)"
    )
    parser.add_argument(
        "--pairs",
        default=None,
        metavar="SPEC",
        help="which pairs, see below (default: the published ones if the set has them, else within-class)",
    )
    parser.add_argument("--limit", type=_count, metavar="N", help="only the first N pairs")
    parser.add_argument(
        "--out", type=Path, default=Path("torchqm-benchmark"), metavar="DIR", help="default: %(default)s"
    )
    parser.add_argument(
        "--jobs",
        type=_count,
        metavar="N",
        help="processes of one thread each (default: all cores); with dask: pairs at a time (default: one a worker)",
    )
    add_backend(parser)
    parser.add_argument(
        "--cache",
        type=Path,
        metavar="DIR",
        help="eigenfunctions ('torchqm prepare') and distances (default: the folder that TORCHQM_CACHE names, else "
        "OUT/cache)",
    )
    parser.add_argument(
        "--points",
        type=_points,
        default=100,
        metavar="N",
        help="points at which errors are measured, spread over the shape (default 100); all: all that the truth has; "
        "landmarks: those of the class (SCB), where published errors with a flip forgiven were measured",
    )
    parser.add_argument(
        "--solver",
        choices=("fast_marching", "heat", "dijkstra"),
        default="fast_marching",
        help="of geodesic distances (default fast_marching; dijkstra to compare with old papers)",
    )
    parser.add_argument(
        "--worst", type=_natural, default=3, metavar="N", help="pairs a method on worst.html (default 3)"
    )
    parser.add_argument("--retry", action="store_true", help="run those again that failed before")
    parser.add_argument("--report", action="store_true", help="run nothing, report what is there")


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: at least 1")
    return value


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text}: at least 0")
    return value


def _points(text: str) -> int:
    """A number of points; 0 stands for all, -1 for the landmarks."""
    return {"all": 0, "landmarks": -1}.get(text) if text in ("all", "landmarks") else _count(text)  # type: ignore[return-value]
