"""What ``torchqm benchmark --help`` says."""

import argparse
import textwrap
from collections.abc import Sequence
from typing import Any

from torchqm.catalogue import DESCRIPTIONS, PAIRS_HELP, PUBLISHED_METHODS

__all__ = ["DESCRIPTION", "Help"]

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
