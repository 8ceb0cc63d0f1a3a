"""A network that was trained on creatures, on shapes of another kind: as it is, and fine-tuned on one class.

    python benchmarks/transfer.py ROOT --pairs SPEC [--checkpoint builtin] [--finetune CLASS --epochs 5] [--out DIR]

Rows: WKS in the network's own solver, the network as it is, and after unsupervised training on the pairs of a class (no
truth is read), each by its own maps: no refinement, no classical matcher (that is `torchqm benchmark ROOT --methods
quotient,learned:builtin`). The symmetries are those of the set. Fine-tuning is `torchqm fit --config
configs/experiment/finetune.yaml --model.start CHECKPOINT --data.root ROOT --data.classes [CLASS]`, into OUT/runs; on
the pairs that are then measured it is fair where no truth is used, and said. Writes benchmarks/results/transfer.json
(or --result); a kill loses one row at most. Rows and trainings of another config, other data or another version are not
taken for these, see benchmarks/kept.py.
"""

import argparse
from dataclasses import fields, replace
from pathlib import Path
from statistics import fmean

from common import RESULTS, ROOT, write_json
from kept import data_digest, kept_rows, made_of, require_same
from learning import NUMBERS, Pairs

from torchqm.cli.learn import fit
from torchqm.cli.sweep_plan import word
from torchqm.data.pairs import choose_pairs
from torchqm.learn import MatchNet, NetOptions, load_net
from torchqm.learn.files import digest

CONFIG = ROOT / "configs" / "experiment" / "finetune.yaml"


def finetuned(start: str, pairs: Pairs, cls: str, epochs: int, lr: float, out: Path) -> MatchNet:
    """The network after unsupervised training on all pairs of a class, now or before; a run that was killed goes on.

    Raises:
        SystemExit: the folder has a training that was made of something else.
    """
    net = load_net(start)
    every = choose_pairs(pairs.shapes, "within-class+unordered")
    chosen = [pair for pair in every if pairs.shapes.shape_class(pair[0]) == cls]
    about = made_of(
        *(CONFIG, pairs.shapes.root),
        data=data_digest(pairs.shapes, chosen),
        start=digest(net),
        cls=cls,
        epochs=epochs,
        lr=lr,
    )
    folder = out / "runs" / f"{cls}-{digest(net)[:8]}-{epochs}-{lr:g}"
    require_same(folder, about)
    last = folder / "checkpoints" / "last.ckpt"
    if not (folder / "done").exists():
        options = {field.name: getattr(net.options, field.name) for field in fields(NetOptions)}
        options |= {"supervision": "none", "start": start, "lr": lr}
        given = {f"model.{name}": list(v) if isinstance(v, tuple) else v for name, v in options.items()}
        given |= {"data.root": str(pairs.shapes.root), "data.classes": [cls], "data.cache_dir": str(pairs.basis_cache)}
        given |= {"trainer.max_epochs": epochs, "trainer.logger.init_args.save_dir": str(out / "runs")}
        given |= {"trainer.logger.init_args.version": folder.name}
        words = [part for name, value in given.items() for part in (f"--{name}", word(value))]
        fit(["--config", str(CONFIG), *words, *(["--ckpt_path", str(last)] if last.exists() else [])])
        (folder / "done").touch()
    return load_net(last)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root")
    parser.add_argument("--pairs", default="within-class+unordered")
    parser.add_argument("--checkpoint", default="builtin")
    parser.add_argument("--finetune", metavar="CLASS")
    parser.add_argument("--epochs", type=int, default=5)
    parser.add_argument("--lr", type=float, default=1e-3)
    parser.add_argument("--cache", type=Path, help="of eigenfunctions (default: OUT/cache)")
    parser.add_argument("--out", type=Path, default=Path("runs") / "transfer")
    parser.add_argument("--result", type=Path, default=RESULTS / "transfer.json")
    arguments = parser.parse_args()
    pairs = Pairs(arguments.root, arguments.pairs, arguments.out / "cache", arguments.cache or arguments.out / "cache")
    net = load_net(arguments.checkpoint)
    nets = {"WKS": MatchNet(replace(net.options, network="none")).eval(), "learned": net}
    if arguments.finetune:
        cls = arguments.finetune
        given = (arguments.checkpoint, pairs, cls, arguments.epochs, arguments.lr, arguments.out)
        nets[f"fine-tuned on {cls}"] = finetuned(*given)
    same = made_of(
        *(CONFIG, arguments.root),
        data=data_digest(pairs.shapes, pairs.pairs),
        pairs=pairs.pairs,
        points=pairs.settings.points,
    )
    results = []
    for name, one in nets.items():
        about = {"net": digest(one)} | same
        file = arguments.out / "results" / f"{digest(one)[:16]}-{Path(arguments.pairs).stem}.json"
        rows = kept_rows(file, about, lambda one=one: pairs.measure(pairs.with_net(one)))
        classes = sorted({pairs.shapes.shape_class(row["pair"][0]) for row in rows})
        for cls in ("all", *classes):
            some = [row for row in rows if cls in ("all", pairs.shapes.shape_class(row["pair"][0]))]
            result = {"features": name, "class": cls, "n_pairs": len(some)}
            results.append(result | {number: fmean(row[number] for row in some) for number in NUMBERS})
            print(results[-1], flush=True)
    write_json(arguments.result, {"checkpoint": digest(net), "root": Path(arguments.root).name, "table": results})
    print(f"written: {arguments.result}")


if __name__ == "__main__":
    main()
