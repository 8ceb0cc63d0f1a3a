"""Trained networks in files: safetensors with the options as JSON in the metadata; checkpoints are read, too."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchqm.geometry.files import write_whole
from torchqm.learn.checkpoints import SUFFIX, find_weights, read_checkpoint, require_finite
from torchqm.learn.net import MatchNet
from torchqm.learn.options import NetOptions
from torchqm.version import __version__

__all__ = ["differences", "digest", "load_net", "save_net"]

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
    require_finite(path, state)
    return options, state, about.get("digest")


def _read_checkpoint(path: Path) -> _Read:
    content = read_checkpoint(path)
    names = {field.name for field in fields(NetOptions)}
    options = {name: value for name, value in content["hyper_parameters"].items() if name in names}
    state = {name: value for name, value in content["state_dict"].items() if name.startswith(_PREFIX)}
    return options, {name.removeprefix(_PREFIX): value for name, value in state.items()}, None
