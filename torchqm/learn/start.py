"""Begin a training with the weights of another."""

from pathlib import Path

from torchqm.learn.files import load_net
from torchqm.learn.net import MatchNet
from torchqm.learn.options import other_architecture

__all__ = ["start_from"]


def start_from(net: MatchNet, path: str | Path) -> None:
    """Give a network the weights of a trained one.

    Both must be of one architecture and read the same features; set-up, supervision and the weights of the loss may be
    others: that is what fine-tuning is for.

    Args:
        net: its weights are replaced.
        path: what :func:`torchqm.learn.load_net` reads: a file, the folder of a run, or ``builtin``.

    Raises:
        ValueError: there is no such file, it is damaged, or its network is another; ``net`` is as it was.

    Example:
        >>> from torchqm.learn import NetOptions
        >>> net = MatchNet(NetOptions(setup="quotient", supervision="orbit"))
        >>> start_from(net, "builtin")
        >>> start_from(MatchNet(NetOptions(width=64)), "builtin")
        Traceback (most recent call last):
            ...
        ValueError: start: builtin holds another architecture: width is 64 here and 128 there
    """
    try:
        other = load_net(path)
    except ValueError as error:
        raise ValueError(f"start: {error}") from error
    differing = other_architecture(vars(net.options), vars(other.options))
    faults = [f"{name} is {here} here and {there} there" for name, here, there in differing]
    if faults:
        raise ValueError(f"start: {path} holds another architecture: {', '.join(faults)}")
    # In their order: with dropout, which has no weights, the layers are numbered otherwise.
    net.load_state_dict(dict(zip(net.state_dict(), other.state_dict().values(), strict=True)))
