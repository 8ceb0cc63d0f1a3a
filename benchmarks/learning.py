"""Learned features against wave kernel signatures in the same pipeline, with three seeds.

    python benchmarks/learning.py [--seeds 0 1 2] [--out DIR] [--matcher] [--test-root ROOT --pairs SPEC] [-- ARGS]

{WKS, learned} x {functional map, quotient, quotient+odd} x {direct error, orbit error, flip rate}. The networks are
trained as by `train/fit.py --config configs/experiment/quick.yaml`, with ARGS, into OUT/runs; WKS are the same pipeline
and solver with the network left out (`network: none`), so that there is nothing to train. All are tested on the same
pairs, of unseen bodies and triangulations, or those of --test-root. With --matcher the features are also given to the
classical matcher as descriptors, without its refinement and with it, the true symmetries being known. Each result is a
file of its own: after a kill the same command goes on. Rows that another config, other data, other ARGS or another
version made are made again, and a training that they made is refused. Writes benchmarks/results/learning.json (or
--result).
Errors are geodesic / sqrt(area), at 100 points of each pair, from torchqm.evaluate.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from statistics import fmean, stdev
from time import perf_counter
from typing import Any

import torch
import yaml
from common import RESULTS, ROOT, write_json
from kept import data_digest, kept_rows, made_of, require_same

import torchqm.data.datamodule as datamodule
from torchqm.benchmark.measure import measure_pair
from torchqm.benchmark.plan import Settings
from torchqm.cli.learn import fit
from torchqm.data import ItemOptions, collate, make_item, open_shapes
from torchqm.data.pairs import choose_pairs
from torchqm.learn import LearnedDescriptors, MatchNet, load_net
from torchqm.learn.files import digest
from torchqm.learn.options import SETUPS
from torchqm.matching import MatchParameters, PreparedShape, given_symmetry, match_prepared, prepare

CONFIG = ROOT / "configs" / "experiment" / "quick.yaml"
NUMBERS = {
    "direct": "plain_mean",
    "orbit": "orbit_mean",
    "flipped_maps": "flip_map",
    "flipped_points": "flip_points",
}
MATCHERS = {
    "matcher, unrefined": MatchParameters(refinement="none", k_quotient=0),
    "matcher": MatchParameters(),
}
# Creatures are grown when they are asked for, which takes as long as training: once for all runs, not once for each.
open_once = datamodule.open_shapes = lru_cache(open_shapes)

Match = Callable[[str, str], torch.Tensor]


class Pairs:
    """The test pairs, with what the methods make of their shapes, each computed once."""

    def __init__(self, root: str, spec: str, cache: Path, basis_cache: Path) -> None:
        self.shapes = open_once(root)
        self.pairs = choose_pairs(self.shapes, spec)
        self.settings = Settings(root, cache, cache=cache)
        self.basis_cache = basis_cache
        self.item = lru_cache(maxsize=8)(self._item)
        self.prepared = lru_cache(maxsize=8)(self._prepared)

    def _item(self, name: str, keys: tuple[str, ...], k: int) -> dict[str, Any]:
        options = ItemOptions(keys=keys, k=k, dtype=torch.float32, cache_dir=self.basis_cache)
        return collate([make_item(self.shapes, name, options)])

    def _prepared(self, name: str) -> PreparedShape:
        return prepare(self.shapes.mesh(name), cache_dir=self.basis_cache)

    def with_net(self, net: MatchNet) -> Match:
        """The network's own map."""

        def match(first: str, second: str) -> torch.Tensor:
            x, y = (self.item(name, net.options.keys, net.options.k) for name in (first, second))
            with torch.no_grad():
                return net(x, y).maps.points(y["verts_mask"])[0]

        return match

    def with_matcher(self, net: MatchNet | None, parameters: MatchParameters) -> Match:
        """The classical matcher with the network's features, or with its own descriptors."""
        descriptors = None if net is None else LearnedDescriptors(net)

        def match(first: str, second: str) -> torch.Tensor:
            x, y = self.prepared(first), self.prepared(second)
            known = []
            for shape, name in ((x, first), (y, second)):
                group = self.shapes.symmetry(name)
                if group is None:
                    raise ValueError(f"{self.settings.root}: the true symmetry of {name} is not known")
                known.append(given_symmetry(shape, group.maps))
            return match_prepared(x, y, *known, "quotient", parameters, descriptors=descriptors).maps[0]

        return match

    def measure(self, match: Match) -> list[dict[str, Any]]:
        """One row a pair."""
        rows = []
        for first, second in self.pairs:
            for name in (first, second):
                self.shapes.mesh(name)
            start = perf_counter()
            p2p = match(first, second)
            seconds = perf_counter() - start
            row = measure_pair(self.shapes, first, second, p2p, self.settings).row
            rows.append({"pair": [first, second], **{n: float(row[k]) for n, k in NUMBERS.items()}, "seconds": seconds})
        return rows


def trained(setup: str, seed: int, out: Path, more: list[str]) -> MatchNet:
    """A network of a set-up, trained now or before; a run that was killed goes on.

    Raises:
        SystemExit: the folder has a training with another config or other arguments, or of another version.
    """
    folder = out / "runs" / setup / f"seed{seed}"
    require_same(folder, made_of(CONFIG, data_of(CONFIG)["root"], setup=setup, seed=seed, arguments=more))
    last = folder / "checkpoints" / "last.ckpt"
    logger = {"save_dir": str(out / "runs"), "name": setup, "version": f"seed{seed}"}
    if not (folder / "done").exists():
        args = ["--config", str(CONFIG), "--model.setup", setup, "--seed_everything", str(seed)]
        args += ["--data.cache_dir", str(out / "cache"), *more]
        args += [part for name, value in logger.items() for part in (f"--trainer.logger.init_args.{name}", value)]
        start = perf_counter()
        fit([*args, *(["--ckpt_path", str(last)] if last.exists() else [])])
        (folder / "done").write_text(f"{perf_counter() - start:.1f}\n")
    return load_net(folder)


def data_of(config: Path) -> dict[str, Any]:
    """What the data file of a config says."""
    return yaml.safe_load((config.parent / yaml.safe_load(config.read_text())["data"]).read_text())


def cases(arguments: argparse.Namespace, pairs: Pairs) -> Iterator[tuple[dict[str, Any], str, Callable[[], Match]]]:
    """What is measured: its row, a name of what it depends on, and what makes its maps."""
    nets: dict[tuple[str, str, int | None], MatchNet] = {}
    seeds = arguments.seeds
    for setup in arguments.setups:
        some = trained(setup, seeds[0], arguments.out, arguments.more)
        nets["WKS", setup, None] = MatchNet(replace(some.options, network="none")).eval()
        for seed in seeds:
            nets["learned", setup, seed] = trained(setup, seed, arguments.out, arguments.more)
    for (features, setup, seed), net in nets.items():
        row = {"features": features, "setup": setup, "seed": seed}
        yield row, digest(net), lambda net=net: pairs.with_net(net)
    if not arguments.matcher:
        return
    for name, parameters in MATCHERS.items():
        yield (
            {"features": "WKS", "setup": name, "seed": None},
            f"{name} {parameters}",
            lambda parameters=parameters: pairs.with_matcher(None, parameters),
        )
        for (features, setup, seed), net in nets.items():
            if features == "learned" and setup == SETUPS[-1]:
                yield (
                    {"features": features, "setup": name, "seed": seed},
                    f"{name} {parameters} {digest(net)}",
                    lambda net=net, parameters=parameters: pairs.with_matcher(net, parameters),
                )


def table(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over pairs, then mean and standard deviation over seeds."""
    groups: dict[tuple[str, str], list[dict[str, float]]] = {}
    for one in results:
        means = {name: fmean(row[name] for row in one["rows"]) for name in NUMBERS}
        groups.setdefault((one["setup"], one["features"]), []).append(means)
    out = []
    for (setup, features), means in groups.items():
        row: dict[str, Any] = {"setup": setup, "features": features, "runs": len(means)}
        for name in NUMBERS:
            values = [one[name] for one in means]
            row[name] = fmean(values)
            row |= {f"{name}_std": stdev(values)} if len(values) > 1 else {}
        out.append(row)
    return sorted(out, key=lambda row: ([*SETUPS, *MATCHERS].index(row["setup"]), row["features"] != "WKS"))


def show(rows: list[dict[str, Any]]) -> None:
    print(f"{'':20} {'':8} {'direct error':>16} {'orbit error':>16} {'flipped maps':>14} {'flipped points':>15}")
    for row in rows:
        cells = [f"{row[n]:.4f}" + (f" ±{row[n + '_std']:.4f}" if n + "_std" in row else "") for n in NUMBERS]
        print(f"{row['setup']:20} {row['features']:8} {cells[0]:>16} {cells[1]:>16} {cells[2]:>14} {cells[3]:>15}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--setups", nargs="+", choices=SETUPS, default=list(SETUPS))
    parser.add_argument("--out", type=Path, default=Path("runs") / "learning")
    parser.add_argument("--result", type=Path, default=RESULTS / "learning.json")
    parser.add_argument("--test-root", help="other shapes to test on (default: those of the configuration)")
    parser.add_argument("--pairs", default="within-class+unordered", help="of the test shapes")
    parser.add_argument("--cache", type=Path, help="of eigenfunctions of the test shapes (default: OUT/cache)")
    parser.add_argument("--matcher", action="store_true", help="also as descriptors in the classical matcher")
    parser.add_argument("more", nargs="*", metavar="ARGS", help="of training, after --")
    arguments = parser.parse_args()
    root = arguments.test_root or data_of(CONFIG)["test_root"]
    cache = arguments.out / "cache"
    pairs = Pairs(root, arguments.pairs, cache, arguments.cache or cache)
    same = made_of(
        *(CONFIG, root),
        data=data_digest(pairs.shapes, pairs.pairs),
        pairs=pairs.pairs,
        points=pairs.settings.points,
        arguments=arguments.more,
    )
    results = []
    for row, depends, make in cases(arguments, pairs):
        about = row | {"depends": depends} | same
        name = "-".join(map(str, row.values())).replace(" ", "_")
        path = arguments.out / "results" / f"{Path(root).name if arguments.test_root else 'quick'}-{name}.json"
        rows = kept_rows(path, about, lambda make=make: pairs.measure(make()))
        results.append(row | {"rows": rows})
        print(row, {name: round(fmean(r[name] for r in rows), 4) for name in NUMBERS}, flush=True)
    rows = table(results)
    show(rows)
    write_json(
        arguments.result,
        {"root": root, "n_pairs": len(pairs.pairs), "points": pairs.settings.points, "training": arguments.more}
        | {"table": rows, "results": results},
    )
    print(f"written: {arguments.result}")


if __name__ == "__main__":
    main()
