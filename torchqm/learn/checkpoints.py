"""Checkpoints of Lightning: which one of a run folder is the best, and what one holds; nothing in it is executed."""

import re
import warnings
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile, ZipFile, is_zipfile

import torch
from torch import Tensor

from torchqm.learn.options import NetOptions

__all__ = ["BUILTIN", "SUFFIX", "find_weights", "read_checkpoint", "require_finite"]

BUILTIN = "builtin"
"""Names the network that ships with torchqm."""

SUFFIX = ".safetensors"
"""Of the files of :func:`torchqm.learn.save_net`."""


def find_weights(path: str | Path) -> Path:
    """The file that a network is read from: the path itself, the best checkpoint of a run folder, or its last.

    Which one scored best is what the checkpoints remember, whatever they are called: of those that remember one that is
    still there, the one of the largest step. If callbacks in it disagree, that of the options ``checkpoint`` counts,
    with a warning. Where no checkpoint remembers any, it is the last by name of those called ``best``, else ``last``,
    else of all, with a warning if there are several.

    Raises:
        ValueError: there is nothing, or no checkpoint in the folder.
    """
    if str(path) == BUILTIN:
        return Path(__file__).with_name(f"builtin{SUFFIX}")
    if "://" in str(path):
        raise ValueError(f"{path}: a URL; a trained network is read from a file on this machine")
    path = Path(path)
    if path.is_dir():
        folder = path / "checkpoints" if (path / "checkpoints").is_dir() else path
        if (best := _best_of(folder)) is not None:
            return best
        for pattern in ("best*.ckpt", "last*.ckpt", "*.ckpt"):
            found = sorted(folder.glob(pattern), key=_natural)
            if found:
                if (count := len(list(folder.glob("*.ckpt")))) > 1:
                    warnings.warn(
                        f"{found[-1]}: taken for its name: no checkpoint in {folder} says which of the {count} scored "
                        "best",
                        stacklevel=2,
                    )
                return found[-1]
        raise ValueError(f"{path}: no checkpoint in {folder}; a folder of a training run has *.ckpt there")
    if not path.is_file():
        raise ValueError(f"{path}: no such file or run folder; '{BUILTIN}' names the network that ships with torchqm")
    if path.suffix not in (SUFFIX, ".ckpt"):
        raise ValueError(f"{path}: a trained network is a {SUFFIX} or a .ckpt file, or the folder of a run")
    return path


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What a Lightning checkpoint of a :class:`torchqm.learn.MatchModule` holds; nothing in it is ever executed.

    Raises:
        ValueError: it is damaged, or something else; the file is named.
    """
    try:
        if is_zipfile(path):  # torch does not look at the sums that it wrote
            with ZipFile(path) as archive:
                damaged = archive.testzip()
            if damaged is not None:
                raise ValueError(f"{damaged} in it is not what was written")
        content = torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:
        # Of a pickle with other objects, and of what is no pickle at all. What torch says is how to execute it.
        found = re.search(r"(?:GLOBAL|global) (\w+(?:\.\w+)+)", str(error))
        what = f" ({found[1]})" if found else ""
        raise ValueError(f"{path}: damaged, or holds more than weights{what} and is not read") from error
    except (OSError, RuntimeError, EOFError, KeyError, ValueError, BadZipFile) as error:
        raise ValueError(f"{path}: damaged, cut short or no checkpoint ({_short(error)})") from error
    needed = ("state_dict", "hyper_parameters")
    if not isinstance(content, dict) or any(not isinstance(content.get(name), dict) for name in needed):
        raise ValueError(f"{path}: no checkpoint of torchqm.learn.MatchModule ({' and '.join(needed)} are needed)")
    if not {field.name for field in fields(NetOptions)} & set(content["hyper_parameters"]):
        raise ValueError(
            f"{path}: no checkpoint of torchqm.learn.MatchModule: its hyperparameters are those of another"
        )
    require_finite(path, content["state_dict"])
    return content


def require_finite(path: Path, state: Mapping[str, Any]) -> None:
    """Refuse weights that are no numbers.

    Raises:
        ValueError: some are NaN or infinite; file and weights are named.
    """
    bad = [name for name, v in state.items() if isinstance(v, Tensor) and not bool(torch.isfinite(v).all())]
    if bad:
        more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
        raise ValueError(f"{path}: weights that are NaN or infinite: {', '.join(bad[:3])}{more}")


def _best_of(folder: Path) -> Path | None:
    """The checkpoint that the one of the largest step remembers as the best; None if none does.

    A ``last`` comes after another of the same step, since it is written after it.
    """
    paths = sorted(folder.glob("*.ckpt"), key=lambda path: (path.stem.startswith("last"), _natural(path)))
    largest, path, known = -1, folder, list[Path]()
    for each in paths:
        step, found = _remembered(each)
        if found and step >= largest:
            largest, path, known = step, each, found
    if len(known) > 1:
        others = " and ".join(other.name for other in known[1:])
        warnings.warn(
            f"{known[0]}: taken as the best; the callbacks of {path.name} disagree, others have {others}", stacklevel=3
        )
    return known[0] if known else None


def _remembered(path: Path) -> tuple[int, list[Path]]:
    """The step of a checkpoint, and those beside it that had scored best by then; none if nothing is known.

    Callbacks that kept by no score say nothing of the best where others have one. Of several that differ the first is
    that of the options ``checkpoint``, the others are by the names of their callbacks.
    """
    try:
        content = read_checkpoint(path)
    except ValueError:  # to be told when it is used
        return 0, []
    states, step = content.get("callbacks"), content.get("global_step")
    there: dict[bool, list[Path]] = {True: [], False: []}
    for _, state in sorted(states.items(), key=_own_first) if isinstance(states, dict) else ():
        if isinstance(state, dict) and state.get("best_model_path"):
            best = path.with_name(Path(str(state["best_model_path"])).name)
            if best.is_file():
                there[state.get("best_model_score") is not None].append(best)
    return step if isinstance(step, int) else 0, list(dict.fromkeys(there[True] or there[False]))


def _own_first(state: tuple[Any, Any]) -> tuple[bool, str]:
    """Lightning begins the name of a callback's state with its class."""
    name = str(state[0])
    return not name.startswith("BestCheckpoint"), name


def _natural(path: Path) -> list[tuple[int, str]]:
    """``epoch=10`` comes after ``epoch=9``."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.stem)]


def _short(error: Exception) -> str:
    return (str(error) or type(error).__name__).strip().splitlines()[0][:200]
