import io
import warnings

import pytest

from torchqm.cli.console import Progress, warnings_as_lines


class Clock:
    """Time that goes on only when told to."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def test_progress_prints_a_line_a_step_with_share_and_time_left():
    stream, clock = io.StringIO(), Clock()
    with Progress(stream, live=False, clock=clock) as progress:
        clock.now += 50  # before the first step: does not count
        with progress.step("first", 0.25):
            clock.now += 2
        with progress.stage(0.75):
            progress.listener("second", -1.0, 0.0)
            clock.now += 2
            progress.listener("second", 2.0, 1 / 3)
            progress.listener("third", -1.0, 1 / 3)
            clock.now += 4
            progress.listener("third", 4.0, 1.0)
    assert stream.getvalue().splitlines() == [
        "[ 25 %] first: 2.0 s, about 6 s left",
        "[ 50 %] second: 2.0 s, about 4 s left",
        "[100 %] third: 4.0 s",
    ]
    assert progress.seconds == {"first": 2.0}


def test_share_never_goes_back():
    stream = io.StringIO()
    with Progress(stream, live=False, clock=Clock()) as progress:
        progress.listener("a", 1.0, 0.6)
        progress.listener("b", 1.0, 0.2)
    assert [line[:7] for line in stream.getvalue().splitlines()] == ["[ 60 %]", "[ 60 %]"]


def test_on_a_terminal_one_line_is_rewritten_and_wiped_at_the_end():
    stream, clock = io.StringIO(), Clock()
    with Progress(stream, live=True, clock=clock) as progress:
        progress.listener("eigenpairs", -1.0, 0.5)
        clock.now += 3
        progress.listener("eigenpairs", 3.0, 0.75)
    written = stream.getvalue()
    assert "\n" not in written
    assert "[ 50 %] eigenpairs (0 s)" in written
    assert "[ 75 %], about 1 s left" in written
    assert written.endswith("\r\033[K")


def test_a_warning_for_the_user_is_a_line_and_the_others_stay_what_they_are(capsys):
    with warnings.catch_warnings(record=True) as caught, warnings_as_lines():
        warnings.warn("taken for its name", stacklevel=1)
        warnings.warn("old", DeprecationWarning, stacklevel=1)
    assert [str(one.message) for one in caught] == ["old"]
    assert capsys.readouterr().err == "torchqm: warning: taken for its name\n"
    with pytest.warns(UserWarning, match="after"):
        warnings.warn("after", stacklevel=1)
