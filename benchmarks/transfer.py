"""A network that was trained on creatures, on shapes of another kind: as it is, and fine-tuned on one class.

    python benchmarks/transfer.py ROOT --pairs SPEC [--checkpoint builtin] [--finetune CLASS --epochs 5] [--out DIR]

Rows: WKS in the network's own solver, the network as it is, and after unsupervised training on the pairs of a class (no
truth is read), each by its own maps: no refinement, no classical matcher (that is `torchqm benchmark ROOT --methods
quotient,learned:builtin`). The symmetries are those of the set. Fine-tuning on the pairs that are then measured is fair
where no truth is used, and said. Writes benchmarks/results/transfer.json (or --result); a kill loses one row at most.
"""

import argparse
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from time import perf_counter

import torch
from common import RESULTS, write_json
from learning import NUMBERS, Pairs, kept

from torchqm.data.pairs import choose_pairs
from torchqm.learn import MatchNet, load_net, save_net
from torchqm.learn.files import digest


def finetuned(net: MatchNet, pairs: Pairs, cls: str, epochs: int, lr: float, path: Path) -> MatchNet:
    """The network after unsupervised training on all pairs of a class; from its file if it was made before."""
    if path.exists():
        return load_net(path)
    spec = "within-class+unordered"
    chosen = [pair for pair in choose_pairs(pairs.shapes, spec) if pairs.shapes.shape_class(pair[0]) == cls]
    net = deepcopy(net).train()
    optimizer = torch.optim.AdamW(net.parameters(), lr=lr)
    start = perf_counter()
    for epoch in range(epochs):
        order = torch.randperm(len(chosen), generator=torch.Generator().manual_seed(epoch)).tolist()
        losses = []
        for number in order:
            x, y = (pairs.item(name, net.options.keys, net.options.k) for name in chosen[number])
            loss = torch.stack(list(net.losses({"first": x, "second": y}).values())).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        print(f"{cls}, epoch {epoch + 1}: loss {fmean(losses):.2f}, {perf_counter() - start:.0f} s", flush=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_net(net, path, {"from": digest(net), "class": cls, "epochs": epochs, "lr": lr, "pairs": len(chosen)})
    return net.eval()


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
        path = arguments.out / f"{digest(net)[:8]}-{cls}-{arguments.epochs}-{arguments.lr:g}.safetensors"
        nets[f"fine-tuned on {cls}"] = finetuned(net, pairs, cls, arguments.epochs, arguments.lr, path)
    results = []
    for name, one in nets.items():
        about = {"net": digest(one), "root": arguments.root, "pairs": [list(pair) for pair in pairs.pairs]}
        file = arguments.out / "results" / f"{digest(one)[:16]}-{Path(arguments.pairs).stem}.json"
        rows = kept(file, about, lambda one=one: pairs.measure(pairs.with_net(one)))
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
