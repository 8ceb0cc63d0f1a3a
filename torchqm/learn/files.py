"""Trained networks in files: safetensors with the options as JSON in the metadata, and Lightning's checkpoints."""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile, ZipFile, is_zipfile

import torch
from torch import Tensor

from torchqm.geometry.files import write_whole
from torchqm.learn.net import MatchNet
from torchqm.learn.options import NetOptions
from torchqm.version import __version__

__all__ = ["BUILTIN", "SUFFIX", "differences", "digest", "find_weights", "load_net", "read_checkpoint", "save_net"]

BUILTIN = "builtin"
"""Names the network that ships with torchqm."""

SUFFIX = ".safetensors"

FORMAT = 1
_KEY = "torchqm"  # one entry of metadata: the order of several would differ from file to file
_PREFIX = "net."  # of the network inside a MatchModule

_Read = tuple[dict[str, Any], dict[str, Tensor], str | None]
"""Options, weights, and the digest that they were written with."""


def save_net(net: MatchNet, path: str | Path, about: Mapping[str, Any] | None = None) -> Path:
    """Write a network to one safetensors file, whole or not at all; equal networks give equal files.

    Args:
        net: the network.
        path: ends with ``.safetensors``; its folder must be there.
        about: plain values that are kept beside the options: how it was trained, for instance.

    Raises:
        ValueError: another ending.
        OSError: the place cannot be written to.
    """
    from safetensors.torch import save

    path = Path(path)
    if path.suffix != SUFFIX:
        raise ValueError(f"{path}: a trained network is written to a file that ends with {SUFFIX}")
    head = {"format": FORMAT, "version": __version__, "options": _plain(net.options), "digest": digest(net)}
    head["about"] = dict(about or {})
    tensors = {name: value.detach().cpu().contiguous() for name, value in net.state_dict().items()}
    content = save(tensors, {_KEY: json.dumps(head, sort_keys=True)})
    return write_whole(path, lambda file: file.write(content))


def load_net(path: str | Path) -> MatchNet:
    """A trained network, ready for use (in evaluation mode, on the CPU); nothing in a file is ever executed.

    Args:
        path: a file of :func:`save_net`; a Lightning checkpoint (``.ckpt``); the folder of a run, of which
            :func:`find_weights` takes one; or ``builtin``.

    Raises:
        ValueError: there is no such file, it is damaged, holds something else, or its weights do not fit its options;
            the file is named.

    Example:
        >>> import tempfile
        >>> net = MatchNet(NetOptions(k=20, channels=8))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     again = load_net(save_net(net, Path(folder) / "net.safetensors"))
        >>> digest(again) == digest(net), again.options.channels
        (True, 8)
    """
    path = find_weights(path)
    values, state, written = _read(path) if path.suffix == SUFFIX else _read_checkpoint(path)
    unknown = sorted(set(values) - {field.name for field in fields(NetOptions)})
    if unknown:
        raise ValueError(f"{path}: has options that this version of torchqm does not know: {', '.join(unknown)}")
    try:
        given: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
        net = MatchNet(NetOptions(**given))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: its options make no network: {error}") from error
    # Of what the file has, not of the network: later versions may know more options.
    if written is not None and _digest(values, state) != written:
        raise ValueError(f"{path}: damaged: its weights are not those that it was written with")
    if faults := differences(net.state_dict(), state):
        raise ValueError(f"{path}: weights of another architecture than its options say: {faults}")
    # In the precision of the file before anything is copied, so that nothing is rounded.
    net.to(next((v.dtype for v in state.values() if v.is_floating_point()), torch.float32))
    net.load_state_dict(state)
    return net.eval()


def find_weights(path: str | Path) -> Path:
    """The file that :func:`load_net` reads: the path itself, the best checkpoint of a run folder, or its last.

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
                return found[-1]
        raise ValueError(f"{path}: no checkpoint in {folder}; a folder of a training run has *.ckpt there")
    if not path.is_file():
        raise ValueError(f"{path}: no such file or run folder; '{BUILTIN}' names the network that ships with torchqm")
    if path.suffix not in (SUFFIX, ".ckpt"):
        raise ValueError(f"{path}: a trained network is a {SUFFIX} or a .ckpt file, or the folder of a run")
    return path


def _best_of(folder: Path) -> Path | None:
    """The checkpoint that the last one remembers as the best; None if it does not, or it is not there any more."""
    for last in sorted(folder.glob("last*.ckpt"), key=_natural)[::-1]:
        try:
            callbacks = read_checkpoint(last).get("callbacks", {})
        except ValueError:  # to be told when it is used
            continue
        states = callbacks.values() if isinstance(callbacks, dict) else []
        names = [state.get("best_model_path") for state in states if isinstance(state, dict)]
        there = [folder / Path(str(name)).name for name in names if name]
        if found := [path for path in there if path.is_file()]:
            return found[0]
    return None


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
    _require_finite(path, content["state_dict"])
    return content


def _require_finite(path: Path, state: Mapping[str, Any]) -> None:
    bad = [name for name, v in state.items() if isinstance(v, Tensor) and not bool(torch.isfinite(v).all())]
    if bad:
        more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
        raise ValueError(f"{path}: weights that are NaN or infinite: {', '.join(bad[:3])}{more}")


def differences(wanted: Mapping[str, Tensor], given: Mapping[str, Tensor], shown: int = 4) -> str:
    """How the names and shapes of some weights differ from others, in words; empty if they do not.

    Example:
        >>> differences({"a": torch.zeros(2), "b": torch.zeros(1)}, {"a": torch.zeros(3)})
        'b is missing; a is (3,) instead of (2,)'
    """
    faults = [f"{name} is missing" for name in wanted if name not in given]
    faults += [f"{name} is not of it" for name in given if name not in wanted]
    for name, value in wanted.items():
        if name in given and given[name].shape != value.shape:
            faults.append(f"{name} is {tuple(given[name].shape)} instead of {tuple(value.shape)}")
    more = f" and {len(faults) - shown} more" if len(faults) > shown else ""
    return "; ".join(faults[:shown]) + more


def digest(net: MatchNet) -> str:
    """SHA-256 of all that a network computes with: its options and its weights, not where or how they are kept."""
    return _digest(_plain(net.options), net.state_dict())


def _digest(options: Mapping[str, Any], state: Mapping[str, Tensor]) -> str:
    found = hashlib.sha256(json.dumps(options, sort_keys=True).encode())
    for name, value in sorted(state.items()):
        array = value.detach().cpu().contiguous()
        found.update(f"{name} {array.dtype} {tuple(array.shape)};".encode())
        found.update(array.reshape(-1).view(torch.uint8).numpy().tobytes())  # NumPy has no bfloat16
    return found.hexdigest()


def _plain(options: NetOptions) -> dict[str, Any]:
    return {name: list(v) if isinstance(v, list | tuple) else v for name, v in asdict(options).items()}


def _read(path: Path) -> _Read:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            head = (file.metadata() or {}).get(_KEY)
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise ValueError(f"{path}: damaged, cut short or no safetensors file ({error})") from error
    try:
        about = json.loads(head or "null")
        options = about["options"]
        if about["format"] != FORMAT or not isinstance(options, dict):
            raise ValueError(f"{path}: of format {about['format']!r}; this version of torchqm reads {FORMAT}")
    except (json.JSONDecodeError, TypeError, KeyError) as error:
        raise ValueError(f"{path}: safetensors, but no network of torchqm: its metadata has no options") from error
    _require_finite(path, state)
    return options, state, about.get("digest")


def _read_checkpoint(path: Path) -> _Read:
    content = read_checkpoint(path)
    names = {field.name for field in fields(NetOptions)}
    options = {name: value for name, value in content["hyper_parameters"].items() if name in names}
    state = {name: value for name, value in content["state_dict"].items() if name.startswith(_PREFIX)}
    return options, {name.removeprefix(_PREFIX): value for name, value in state.items()}, None


def _natural(path: Path) -> list[tuple[int, str]]:
    """``epoch=10`` comes after ``epoch=9``."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.stem)]


def _short(error: Exception) -> str:
    return (str(error) or type(error).__name__).strip().splitlines()[0][:200]
