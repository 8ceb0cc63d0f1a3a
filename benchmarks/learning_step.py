"""Seconds of a training step under Lightning against a bare loop of torch with the same network; bound 10 % more.

    python benchmarks/learning_step.py [--verts 5000] [--k 128] [--setup quotient+odd] [--rounds 5] [--out FILE]

Both take the same pairs from the same loader, start from the same weights and step with the same AdamW. One round is an
epoch of four pairs with the one, then one with the other; a step is the time from one batch to the next, so that
loading, logging, checks and callbacks (those that ``torchqm fit`` gives every run, with its logger) are counted. Of an
epoch the first step is left out, since what is built once falls into it, and the last, which no batch follows: what is
done once an epoch (checkpoints, curves, pictures) is no part of a step. Seconds are those of the clock and those of the
processor in this process; on a machine with other work only the latter compare. Writes
benchmarks/results/learning_step.json.
"""

import argparse
import tempfile
import warnings
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
import torch
from common import RESULTS, write_json
from pytorch_lightning import Callback, Trainer

from torchqm.cli.lightning import own_callbacks
from torchqm.data.datamodule import PairDataModule
from torchqm.learn import MatchModule
from torchqm.learn.callbacks import BestCheckpoint
from torchqm.learn.logger import RunLogger
from torchqm.learn.options import SETUPS
from torchqm.viz.callbacks import PairPictures

BOUND_SHARE = 0.10


Seconds = list[tuple[float, float]]
"""Of the clock, and of the processor."""


class Clock(Callback):
    """Seconds from each batch to the next."""

    def __init__(self) -> None:
        self.seconds: Seconds = []
        self._begin: tuple[float, float] | None = None

    def tick(self) -> None:
        now = perf_counter(), process_time()
        if self._begin is not None:
            self.seconds.append((now[0] - self._begin[0], now[1] - self._begin[1]))
        self._begin = now

    def on_train_batch_start(self, *_: Any) -> None:
        self.tick()


def under_lightning(module: MatchModule, data: PairDataModule, folder: Path) -> Seconds:
    """Steps of an epoch as ``torchqm fit`` has it."""
    clock = Clock()
    best = BestCheckpoint(monitor="val_orbit_error", filename="best-{epoch}")
    trainer = Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=1,
        deterministic=True,
        log_every_n_steps=1,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        logger=RunLogger(str(folder)),
        callbacks=[clock, best, PairPictures(), *own_callbacks()],
    )
    trainer.fit(module, data)
    return clock.seconds[1:]


def bare(net: torch.nn.Module, data: PairDataModule, lr: float) -> Seconds:
    """The same steps in a loop."""
    optimizer = torch.optim.AdamW(net.parameters(), lr=lr, weight_decay=0.0)
    clock = Clock()
    for batch in data.train_dataloader():
        clock.tick()
        loss = sum(net.losses(batch).values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return clock.seconds[1:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--verts", type=int, default=5000)
    parser.add_argument("--k", type=int, default=128)
    parser.add_argument("--network", default="mlp", choices=("mlp", "diffusion"))
    parser.add_argument("--setup", default="quotient+odd", choices=SETUPS)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULTS / "learning_step.json")
    args = parser.parse_args()
    warnings.filterwarnings("ignore")
    torch.use_deterministic_algorithms(True)  # as Lightning does it; the loop shall not win by that
    options = {"setup": args.setup, "k": args.k, "network": args.network, "seed": 0}
    extra = ("gradients",) if args.network == "diffusion" else ()
    data = PairDataModule(
        f"synthetic:kinds=ellipsoid;poses=2;verts={args.verts};triangulation=shared",
        pairs="within-class+self",
        shares=(1, 0, 0),
        k=args.k,
        keys=("mass", "basis", "group", *extra),
    )
    data.setup("fit")
    vertices = [int(batch["first"]["verts_mask"].sum()) for batch in data.train_dataloader()]  # computes all bases
    rows: dict[str, list[Seconds]] = {"lightning": [], "bare": []}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(args.rounds + 1):
            print(f"round {number} of {args.rounds}", flush=True)
            found = {
                "lightning": under_lightning(MatchModule(**options), data, Path(folder)),
                "bare": bare(MatchModule(**options).net, data, 1e-3),
            }
            if number:  # the first round is to warm up
                for name, seconds in found.items():
                    rows[name].append(seconds)
    every = {name: np.array(values) for name, values in rows.items()}  # (rounds, steps, 2)
    medians = {name: np.median(values, axis=(0, 1)) for name, values in every.items()}
    overhead = medians["lightning"] / medians["bare"] - 1
    rounds = np.median(every["lightning"], 1) / np.median(every["bare"], 1) - 1
    load = Path("/proc/loadavg")
    result = {
        "vertices": vertices[0],
        "k": args.k,
        "setup": args.setup,
        "network": args.network,
        "rounds": args.rounds,
        "steps_per_round": len(rows["bare"][0]),
        "median_seconds": {name: float(value[0]) for name, value in medians.items()},
        "median_processor_seconds": {name: float(value[1]) for name, value in medians.items()},
        "overhead_share": float(overhead[0]),
        "overhead_share_processor": float(overhead[1]),
        "overhead_shares_of_rounds": rounds[:, 0],
        "overhead_shares_of_rounds_processor": rounds[:, 1],
        "bound_share": BOUND_SHARE,
        "load_average_at_the_end": load.read_text().split()[0] if load.exists() else None,
        "seconds": {name: values[..., 0] for name, values in every.items()},
        "processor_seconds": {name: values[..., 1] for name, values in every.items()},
    }
    print({key: value for key, value in result.items() if not key.endswith("seconds") or "median" in key})
    write_json(args.out, result)


if __name__ == "__main__":
    main()
