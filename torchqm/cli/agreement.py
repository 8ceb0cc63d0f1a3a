"""What model, data and checkpoints of a config must agree on, found before a run folder is made."""

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from torchqm.data.base import TruthError, TruthFileError
from torchqm.data.datamodule import PairDataModule, SwappedTruths

__all__ = ["check_monitor", "check_truth", "first_truths", "monitors", "without_truth"]

_ERRORS = ("plain_error", "orbit_error", "flipped_map", "flipped_points")


def monitors(options: Mapping[str, Any], truth: bool = True) -> list[str]:
    """The names that a training of :class:`torchqm.learn.MatchModule` logs.

    Args:
        options: of the module.
        truth: whether pairs have one.
    """
    terms = [f"l_{name}" for name in ("bij", "orth", "lap", "align") if options[f"w_{name}"] > 0]
    terms += ["l_truth"] if options["supervision"] != "none" else []
    own = ["loss", *terms]
    return [*(f"train_{n}" for n in own), *(f"val_{n}" for n in (*own, *(_ERRORS if truth else ())))]


def check_monitor(name: str | None, options: Mapping[str, Any], truth: bool = True) -> None:
    """Find a monitor that no step will log.

    Raises:
        ValueError: the nearest that there is.
    """
    known = monitors(options, truth)
    if name is None or name in (*known, "epoch", "step"):
        return
    near = get_close_matches(name, known, 1, 0.5)
    hint = f"; the nearest is {near[0]}" if near else ""
    raise ValueError(f"monitor: {name!r} given, but such a run logs only {', '.join(known)}{hint}")


def check_truth(truth: str, supervision: str) -> None:
    """Find a supervision without anything to supervise by.

    Raises:
        ValueError: no truth is read, and the supervision needs it.
    """
    if truth == "none" and supervision != "none":
        raise ValueError(
            f"data.truth: 'none' given, but model.supervision {supervision!r} needs a truth; give data.truth required "
            "or optional, or model.supervision none"
        )


def first_truths(data: PairDataModule, *parts: str) -> None:
    """Look at the truth of the first pair of some parts, where it is required: of many sets no pair has one.

    Raises:
        TruthError: there is none.
    """
    for part in (data.parts[name] for name in parts):
        pairs = part.pairs if isinstance(part, SwappedTruths) else part
        if pairs is not None and pairs.truth_use == "required":
            pairs.items.shapes.truth(*pairs.pairs[0])


def without_truth(error: TruthError) -> str:
    """What a run says that met a pair without a truth; of a process that loads data, the last line of its trace."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    text = lines[-1].partition("Error: ")[2] if lines and lines[0].startswith("Caught ") else " ".join(lines)
    if isinstance(error, TruthFileError):
        return text
    return f"{text}; --data.truth optional takes pairs without a truth, too, --data.truth none reads none at all"
