"""One config trained and tested over seeds and set-ups."""

import argparse
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from torchqm.cli.console import Progress, UserError
from torchqm.cli.sweep_plan import Run, Sweep, read_sweep, runs_of
from torchqm.cli.sweep_results import RESULT, STARTED, kept_result, write_result, write_tables
from torchqm.version import __version__

__all__ = ["fit_and_test", "main", "run_sweep"]

_DESCRIPTION = """\
Train and test a config with each seed, set-up and value of a grid. A run that is finished is
skipped, so the same command goes on where it was stopped (the run that was stopped begins anew).
Writes DIR/NAME/ for each run, and DIR/sweep.csv and DIR/sweep.md."""


def run_sweep(sweep: Sweep, out: Path, progress: Progress, train: Callable[[Run], dict[str, float]]) -> list[Any]:
    """Run what is not finished yet.

    Args:
        sweep: what to run.
        out: folder of all runs.
        progress: told of each run.
        train: trains and tests a run; measured values by name.

    Returns:
        A dictionary for each run: ``run`` (its name), labels, ``seed``, ``status`` (``done``, or what stopped it),
        ``seconds`` and the measured values.

    Raises:
        UserError: a folder has a run with other arguments, of a config that was changed or of another version of
            torchqm, or something that is no run.
    """
    runs = runs_of(sweep, out)
    kept = {run.name: kept_result(out / run.name, run) for run in runs}
    waiting = [run.name for run in runs if kept[run.name] is None]
    rows = []
    for run in runs:
        result = kept[run.name]
        if result is None:
            number = waiting.index(run.name)
            folder = out / run.name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            about = {"arguments": list(run.arguments), "config": run.digest, "torchqm": __version__}
            write_result(folder / STARTED, about)
            progress.listener(run.name, -1.0, number / len(waiting))
            begin = perf_counter()
            try:
                values, status = train(run), "done"
            except UserError as error:  # such as a loss that is not finite: the other runs may do better
                values, status = {}, f"failed: {' '.join(str(error).split())}"
            seconds = perf_counter() - begin
            result = {**about, "status": status, "seconds": seconds, "values": values}
            write_result(folder / RESULT, result)
            progress.listener(run.name, seconds, (number + 1) / len(waiting))
        head = {"run": run.name, **run.labels, "seed": run.seed, "status": result["status"]}
        rows.append(head | {"seconds": round(result["seconds"], 1)} | result["values"])
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """The command; 0 if all runs are done, 1 if some failed, 2 for wrong input, 130 if it was interrupted."""
    import sys

    arguments = _parser().parse_args(argv)
    try:
        rows, labels = _sweep(arguments)
    except UserError as error:
        print(f"sweep: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, SystemExit):
        print("sweep: interrupted; the same command goes on with the runs that are not finished", file=sys.stderr)
        return 130
    print(write_tables(rows, labels, arguments.out))
    return 0 if all(row["status"] == "done" for row in rows) else 1


def _sweep(arguments: argparse.Namespace) -> tuple[list[Any], list[str]]:
    sweep = read_sweep(arguments.sweep) if arguments.sweep else Sweep(_config(arguments))
    sweep = replace(
        sweep,
        seeds=arguments.seeds or sweep.seeds,
        options={**sweep.options, **dict(arguments.set)},
        grid={**sweep.grid, **dict(arguments.grid)},
    )
    from torchqm.cli.learn import learn

    _quiet()
    for run in runs_of(replace(sweep, seeds=sweep.seeds[:1]), arguments.out):
        try:
            learn(run.arguments, run=False)  # a wrong key is found before the first run, not after it
        except UserError as error:
            raise UserError(_in_file(str(error), sweep, arguments, run.name)) from error
    with Progress() as progress:
        rows = run_sweep(sweep, arguments.out, progress, fit_and_test)
    return rows, [*(["setup"] if sweep.setups else []), *sweep.grid]


def _in_file(text: str, sweep: Sweep, arguments: argparse.Namespace, name: str) -> str:
    """The error with the sweep's file and the place in it in front, else the run in which options do not agree."""
    key = text.partition(":")[0].removeprefix("--")
    if re.fullmatch(r"(model|data)\.\w+", key) and key == text.partition(":")[0]:  # it was not given, so is a default
        return f"run {name}: {text}"
    if arguments.sweep is None or key in dict(arguments.set) or key in dict(arguments.grid):
        return text
    groups = {"options": sweep.options, "grid": sweep.grid}
    groups |= {f"setups.{name}": own for name, own in sweep.setups.items()}
    if key == "config":
        return f"{arguments.sweep}: {text.removeprefix('--')}"
    places = [group for group, own in groups.items() if key in own]
    return f"{arguments.sweep}: {places[-1]}: {text.removeprefix('--')}" if places else text


def fit_and_test(run: Run) -> dict[str, float]:
    """Train, then test the best checkpoint (else the last); what the test logs, without the terms of the loss."""
    from torchqm.cli.learn import evaluate, fit

    plain = ("--trainer.enable_progress_bar", "false", "--trainer.enable_model_summary", "false")
    fit([*run.arguments, *plain])
    folder = Path(run.arguments[run.arguments.index("--trainer.logger.init_args.save_dir") + 1]) / run.name
    where = ("--trainer.logger.init_args.save_dir", str(folder), "--trainer.logger.init_args.version", "test")
    tested = evaluate([str(folder), *plain, *where, "--verbose", "false"])
    found = tested.trainer.callback_metrics
    return {name: float(value) for name, value in found.items() if not name.startswith("test_l_")}


def _quiet() -> None:
    """Lightning tells of every run what accelerators there are; one line for each run is enough here."""
    import logging
    import warnings

    import torchqm.cli.lightning  # noqa: F401 - importing Lightning sets its levels

    for name in ("pytorch_lightning", "lightning_fabric", "lightning.fabric", "lightning.pytorch"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module=r"pytorch_lightning\..*|jsonargparse.*")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sweep.py",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "sweep", type=Path, nargs="?", metavar="SWEEP.yaml", help="config, seeds, options, setups, grid"
    )
    parser.add_argument("--config", type=Path, help="instead of SWEEP.yaml: one config of torchqm fit")
    parser.add_argument("--seeds", type=_seeds, metavar="0,1,2", help="instead of those of SWEEP.yaml; default 0")
    parser.add_argument(
        *("--grid", "--set"),
        dest="both",
        action=_Options,
        metavar="KEY=VALUE[,VALUE...]",
        help="--grid model.k=20,40: run each; --set model.lr=1e-2: for all runs; both as often as needed",
    )
    parser.add_argument("--out", type=Path, default=Path("runs/sweep"), metavar="DIR", help="default: %(default)s")
    parser.set_defaults(grid=[], set=[])
    return parser


class _Options(argparse.Action):
    """``--grid KEY=A,B`` and ``--set KEY=A``; values are YAML."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: str | None = None) -> None:
        import yaml

        key, equals, text = str(values).partition("=")
        if not key or not equals:
            parser.error(f"argument {option}: {values!r} given, expected KEY=VALUE")
        name = str(option).removeprefix("--")
        try:
            value = yaml.safe_load(f"[{text}]") if name == "grid" else yaml.safe_load(text)
        except yaml.YAMLError:
            parser.error(f"argument {option}: {text!r} given for {key}, which is no YAML")
        if value == []:
            parser.error(f"argument {option}: {key}: no value given, expected at least one")
        setattr(namespace, name, [*getattr(namespace, name), (key, value)])


def _config(arguments: argparse.Namespace) -> Path:
    if arguments.config is None:
        raise UserError("SWEEP.yaml or --config is needed")
    return Path(arguments.config)


def _seeds(text: str) -> list[int]:
    seeds = [int(word) for word in text.split(",")]
    if any(not 0 <= seed < 2**32 for seed in seeds):
        raise ValueError(text)  # argparse says which argument it was
    return seeds
