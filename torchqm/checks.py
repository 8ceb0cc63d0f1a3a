"""Checks of the tensors that functions and layers are given: what is wrong is named, and what is allowed.

Shapes are always checked. Values (finite, not negative, a mask with a true element) cost a pass over the data and, on a
GPU, a wait for it: :func:`disabled` switches them off. They are also left out while a function is compiled, exported or
transformed by ``torch.func``, where values are not known.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

__all__ = [
    "Sizes",
    "disabled",
    "enabled",
    "require_finite",
    "require_ids",
    "require_mask",
    "require_nonnegative",
    "require_real",
    "set_enabled",
    "wanted",
]

_state = {"enabled": True}


def enabled() -> bool:
    """Whether values are checked here and now."""
    return _state["enabled"] and not _values_unknown()


def wanted() -> bool:
    """Whether values are to be checked, by operators that see them in compiled code, too."""
    return _state["enabled"]


def set_enabled(on: bool) -> None:
    """Switch the checks of values on or off, for the whole process."""
    _state["enabled"] = bool(on)


@contextmanager
def disabled() -> Iterator[None]:
    """Run the body without checks of values: for a training loop whose data were checked before.

    Example:
        >>> with disabled():
        ...     enabled()
        False
    """
    before = _state["enabled"]
    _state["enabled"] = False
    try:
        yield
    finally:
        _state["enabled"] = before


class Sizes:
    """What the letters of shapes stand for, learned from one argument after the other.

    Example:
        >>> sizes = Sizes()
        >>> sizes.bind("evecs", torch.zeros(8, 500, 30), "... V K")
        >>> sizes["V"], sizes.leading
        (500, (8,))
        >>> sizes.bind("mass", torch.zeros(8, 400), "... V")
        Traceback (most recent call last):
        ValueError: mass: shape (8, 400) given, expected (8, V) with V = 500 as in evecs
    """

    def __init__(self) -> None:
        self._known: dict[str, tuple[int, str]] = {}
        self._leading: tuple[tuple[int, ...], str] | None = None
        self._dtype: tuple[torch.dtype, str] | None = None

    def __getitem__(self, letter: str) -> int:
        return self._known[letter][0]

    @property
    def leading(self) -> tuple[int, ...]:
        """The sizes that ``...`` stands for."""
        return self._leading[0] if self._leading else ()

    def bind(self, name: str, tensor: object, dims: str, any_dtype: bool = False) -> None:
        """Check one argument against the letters that are known, and learn the others from it.

        Arguments of real numbers must have one dtype, except under autocast.

        Args:
            name: of the argument, for the message.
            tensor: its value.
            dims: letters or numbers with spaces between them; ``...`` in front stands for any number of batch sizes.
            any_dtype: this one may have a dtype of its own.

        Raises:
            ValueError: the tensor has other sizes or another dtype; ``TypeError`` if it is no tensor.
        """
        if not isinstance(tensor, Tensor):
            raise TypeError(f"{name}: expected a tensor, got {type(tensor).__name__}")
        free = any_dtype or "mask" in name or torch.is_autocast_enabled(tensor.device.type)  # masks: require_mask
        if tensor.is_floating_point() and not free:
            dtype, source = self._dtype or (tensor.dtype, name)
            if tensor.dtype != dtype:
                raise ValueError(f"{name}: dtype {tensor.dtype} given, expected {dtype} as in {source}")
            self._dtype = (dtype, source)
        words = dims.split()
        open_front = words[0] == "..."
        letters = words[1:] if open_front else words
        n = len(letters)
        shape = tuple(tensor.shape)
        if len(shape) < n or (not open_front and len(shape) != n):
            raise ValueError(f"{name}: shape {shape} given, expected ({', '.join(words)})")
        own = shape[len(shape) - n :]
        front = shape[: len(shape) - n]
        fits = not open_front or self._leading is None or front == self._leading[0]
        met: dict[str, int] = {}
        for letter, size in zip(letters, own, strict=True):
            known = int(letter) if letter.isdigit() else self._known.get(letter, (met.setdefault(letter, size), ""))[0]
            fits = fits and size == known
        if not fits:
            raise ValueError(f"{name}: shape {shape} given, expected {self._expected(words)}")
        if open_front and self._leading is None:
            self._leading = (front, name)
        for letter, size in zip(letters, own, strict=True):
            if not letter.isdigit():
                self._known.setdefault(letter, (size, name))

    def _expected(self, words: list[str]) -> str:
        parts, notes = [], []
        for word in words:
            if word == "..." and self._leading is not None:
                parts += [str(size) for size in self._leading[0]]
            else:
                parts.append(word)
                if word in self._known:
                    size, source = self._known[word]
                    notes.append(f"{word} = {size} as in {source}")
        with_ = f" with {', '.join(notes)}" if notes else ""
        return f"({', '.join(parts)}{',' if len(parts) == 1 else ''}){with_}"


def require_real(name: str, tensor: Tensor) -> None:
    """Raise ``ValueError`` if a tensor holds integers, booleans or complex numbers; always, as for shapes.

    Products with integers would be cut to integers, or fail far from where they came in.
    """
    if not tensor.is_floating_point():
        raise ValueError(f"{name}: dtype {tensor.dtype} given, expected real numbers (torch.float32 or torch.float64)")


def require_finite(name: str, tensor: Tensor) -> None:
    """Raise ``ValueError`` where a tensor holds NaN or infinity; says how many and where the first is."""
    require_real(name, tensor)
    # NaN and infinity outlive a sum, which takes a tenth of the time; if finite numbers overflow in it, look closely.
    if not enabled() or bool(torch.isfinite(tensor.detach().sum())):
        return
    bad = ~torch.isfinite(tensor)
    if bool(bad.any()):
        first = tuple(int(i) for i in bad.nonzero()[0])
        raise ValueError(
            f"{name}: {int(bad.sum())} of {bad.numel()} entries are NaN or infinite, the first at {first}; "
            "only finite numbers are allowed"
        )


def require_nonnegative(name: str, tensor: Tensor) -> None:
    """Raise ``ValueError`` where a tensor has a negative or non-finite entry."""
    require_real(name, tensor)
    if not enabled():
        return
    require_finite(name, tensor)
    bad = tensor < 0
    if bool(bad.any()):
        first = tuple(int(i) for i in bad.nonzero()[0])
        raise ValueError(
            f"{name}: {int(bad.sum())} of {bad.numel()} entries are negative, the first at {first} is "
            f"{float(tensor[first]):.3g}; only zero and more are allowed"
        )


def require_ids(name: str, ids: Tensor, n: int, none: bool = False) -> None:
    """Raise ``ValueError`` where an id lies outside ``0..n-1``; with ``none``, -1 is allowed, too."""
    if ids.dtype != torch.int64:
        raise ValueError(f"{name}: dtype {ids.dtype} given, expected vertex ids (torch.int64)")
    if not enabled() or not ids.numel():
        return
    least, most = (int(v) for v in torch.aminmax(ids))
    if least < (-1 if none else 0) or most >= n:
        raise ValueError(
            f"{name}: ids from {least} to {most} given, allowed are 0..{n - 1}{' and -1 (none)' if none else ''}"
        )


def require_mask(name: str, mask: Tensor, empty: bool = False) -> None:
    """Raise ``ValueError`` if a mask is not boolean or one of its rows (last dimension) has no true element.

    With ``empty`` such a row is allowed.
    """
    if mask.dtype != torch.bool:
        raise ValueError(f"{name}: dtype {mask.dtype} given, expected torch.bool (true: real, false: padding)")
    if empty or not enabled():
        return
    without = ~mask.any(-1)
    if bool(without.any()):
        rows = without.reshape(-1).nonzero().flatten().tolist()
        raise ValueError(f"{name}: no true element in row(s) {rows[:5]}; each needs at least one")


def _values_unknown() -> bool:
    # torch has no public question for "inside torch.func"; without this one a check under vmap would raise there.
    return torch.compiler.is_compiling() or torch._C._functorch.peek_interpreter_stack() is not None
