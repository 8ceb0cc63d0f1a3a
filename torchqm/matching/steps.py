"""Timing of the steps of a long computation, told to whoever listens."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter

__all__ = ["StepListener", "Steps"]

StepListener = Callable[[str, float, float], None]
"""Called as ``listener(name, seconds, share)``: at a step's start with ``seconds = -1``, at its end with its duration;
``share`` in [0, 1] is the part of the whole work done by then, as far as it can be known."""


@dataclass
class Steps:
    """A stopwatch for named steps; the same name used twice adds up.

    Args:
        total: expected cost of the whole work, in any unit that ``cost`` is given in.
        listener: told of each step's start and end; see :data:`StepListener`.

    Example:
        >>> steps = Steps(total=2.0)
        >>> with steps("eigenpairs", cost=1.0):
        ...     pass
        >>> list(steps.seconds), steps.share
        (['eigenpairs'], 0.5)
    """

    total: float = 1.0
    listener: StepListener | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    done: float = 0.0

    @property
    def share(self) -> float:
        """Part of the expected work that is done."""
        return min(self.done / self.total, 1.0) if self.total > 0 else 0.0

    def since(self, earlier: dict[str, float]) -> dict[str, float]:
        """Seconds of the steps that were timed after ``earlier``, a copy of :attr:`seconds` made before."""
        spent = {name: total - earlier.get(name, 0.0) for name, total in self.seconds.items()}
        return {name: seconds for name, seconds in spent.items() if seconds > 0}

    @contextmanager
    def __call__(self, name: str, cost: float = 0.0) -> Iterator[None]:
        """Time the body of a ``with`` statement under a name."""
        if self.listener:
            self.listener(name, -1.0, self.share)
        start = perf_counter()
        yield
        spent = perf_counter() - start
        self.seconds[name] = self.seconds.get(name, 0.0) + spent
        self.done += cost
        if self.listener:
            self.listener(name, spent, self.share)
