"""What the commands say: progress on stderr, tables on stdout, one line for an error."""

import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from time import perf_counter
from typing import Any

__all__ = ["Progress", "UserError", "format_table", "print_seconds", "print_warnings", "warnings_as_lines"]


class UserError(Exception):
    """Something that the user can put right; its text is the one line that is printed."""


class Progress:
    """Steps of a long computation on stderr, with the share done and the time left.

    On a terminal one line is rewritten twice a second; into a file each step is a line of its own.

    Args:
        stream: text stream to write to; stderr by default.
        live: whether to rewrite one line; by default whether ``stream`` is a terminal.
        clock: seconds; another one in tests.
    """

    def __init__(self, stream: Any = None, live: bool | None = None, clock: Callable[[], float] = perf_counter) -> None:
        self.stream = sys.stderr if stream is None else stream
        self.live = self.stream.isatty() if live is None else live
        self.clock = clock
        self.seconds: dict[str, float] = {}
        self._began: float | None = None  # the first step's start: imports are no measure of the work
        self._base, self._weight = 0.0, 1.0  # the stage's part of the whole
        self._share, self._step, self._step_began = 0.0, "", 0.0
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._ticker: threading.Thread | None = None

    def __enter__(self) -> "Progress":
        if self.live:
            self._ticker = threading.Thread(target=self._tick, daemon=True)
            self._ticker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._ticker is not None:
            self._ticker.join()
            self._write("\r\033[K")

    @contextmanager
    def stage(self, weight: float) -> Iterator[None]:
        """A part of the work whose own share runs from 0 to 1; the weights of all stages sum to 1."""
        self._weight = weight
        yield
        self._base += weight
        self._share = self._base

    @contextmanager
    def step(self, name: str, weight: float) -> Iterator[None]:
        """A stage of one step."""
        with self.stage(weight):
            self.listener(name, -1.0, 0.0)
            begin = self.clock()
            yield
            spent = self.clock() - begin
            self.seconds[name] = spent
            self.listener(name, spent, 1.0)

    def listener(self, name: str, seconds: float, share: float) -> None:
        """To be told of steps; see :data:`torchqm.matching.steps.StepListener`."""
        with self._lock:
            self._share = max(self._share, self._base + self._weight * min(share, 1.0))
            started = seconds < 0
            self._began = self.clock() if self._began is None else self._began
            self._step = name if started else ""
            self._step_began = self.clock()
        if self.live:
            self._draw()
        elif not started:
            self._write(f"[{self._percent()}] {name}: {seconds:.1f} s{self._left()}\n")

    def _percent(self) -> str:
        return f"{100 * min(self._share, 1.0):3.0f} %"

    def _left(self) -> str:
        """The time left, as long as enough is done to tell."""
        if self._began is None or not 0.05 < self._share < 0.995:
            return ""
        elapsed = self.clock() - self._began
        return f", about {max(elapsed * (1 - self._share) / self._share, 1):.0f} s left"

    def _draw(self) -> None:
        with self._lock:
            running = f" {self._step} ({self.clock() - self._step_began:.0f} s)" if self._step else ""
            running = " reading" if self._began is None else running
            self._write(f"\r\033[K[{self._percent()}]{running}{self._left()}")

    def _tick(self) -> None:
        while not self._stop.wait(0.5):
            self._draw()

    def _write(self, text: str) -> None:
        self.stream.write(text)
        self.stream.flush()


def format_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in plain text: first column to the left, the others to the right, two blanks between.

    Example:
        >>> print(format_table(["map", "error"], [["direct", "0.01"], ["mirrored", "0.2"]]))
        map       error
        direct     0.01
        mirrored    0.2
    """
    lines = [list(head), *(list(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if column else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def print_seconds(seconds: dict[str, float]) -> None:
    """The table of seconds per step, with their sum."""
    rows = [[name, f"{value:.2f}"] for name, value in seconds.items()]
    print(format_table(["step", "seconds"], [*rows, ["total", f"{sum(seconds.values()):.2f}"]]))


@contextmanager
def warnings_as_lines() -> Iterator[None]:
    """A warning for the user is one line on stderr, without the place in the code."""
    plain = warnings.showwarning

    def show(message: Any, category: type[Warning], *rest: Any, **more: Any) -> None:
        if category is UserWarning:
            print_warnings([str(message)])
        else:
            plain(message, category, *rest, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield


def print_warnings(warnings: Sequence[str]) -> None:
    """Each warning as a line on stderr."""
    for text in warnings:
        print(f"torchqm: warning: {text}", file=sys.stderr)
