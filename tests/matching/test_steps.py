import pytest

import torchqm.matching.steps as module
from torchqm.matching.steps import Steps


@pytest.fixture
def clock(monkeypatch):
    """A clock that shows 0, 1, 3, 6, 10, ...: the n-th pair of looks at it is 2 n + 1 seconds apart."""
    looks = iter(n * (n + 1) / 2 for n in range(100))
    monkeypatch.setattr(module, "perf_counter", lambda: next(looks))


def test_equal_names_add_up(clock):
    steps = Steps()
    for name in ("a", "b", "a"):
        with steps(name):
            pass
    assert steps.seconds == {"a": 1 + 5, "b": 3}
    assert list(steps.seconds) == ["a", "b"]


def test_the_listener_hears_start_and_end(clock):
    heard = []
    steps = Steps(total=4.0, listener=lambda *news: heard.append(news))
    with steps("first", cost=1.0):
        assert heard == [("first", -1.0, 0.0)]
    with steps("second", cost=2.0):
        pass
    assert heard[1:] == [("first", 1.0, 0.25), ("second", -1.0, 0.25), ("second", 3.0, 0.75)]


def test_share_stays_between_0_and_1():
    steps = Steps(total=1.0)
    with steps("more than expected", cost=5.0):
        pass
    assert steps.share == 1.0
    assert Steps(total=0.0, done=3.0).share == 0.0


def test_a_failing_step_does_not_count():
    steps = Steps(total=1.0)
    with pytest.raises(RuntimeError, match="inside"), steps("broken", cost=1.0):
        raise RuntimeError("inside")
    assert (steps.seconds, steps.share) == ({}, 0.0)
