"""torchqm.fmap.threads: one thread inside, what was set before outside, also after an error."""

from functools import partial
from threading import Barrier, get_ident

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from torchqm.fmap.threads import in_parallel, one_thread, workers


@pytest.fixture(autouse=True)
def two_threads():
    """As a user has it; the suite itself runs on one."""
    before = torch.get_num_threads()
    with threadpool_limits(2, "blas"):
        torch.set_num_threads(2)
        yield
        torch.set_num_threads(before)


def blas():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_one_thread_inside_and_as_before_after_it():
    outside = blas()
    assert outside
    assert max(outside) == 2
    with one_thread():
        assert torch.get_num_threads() == 1
        assert set(blas()) == {1}
    assert torch.get_num_threads() == 2
    assert blas() == outside


def test_also_after_an_error():
    outside = blas()
    with pytest.raises(KeyError, match="inside"), one_thread():
        raise KeyError("inside")
    assert torch.get_num_threads() == 2
    assert blas() == outside


def test_one_inside_another():
    with one_thread():
        with one_thread():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 1
        assert set(blas()) == {1}
    assert torch.get_num_threads() == 2


def test_threads_before_are_workers_inside():
    assert workers() == 1
    with one_thread():
        assert workers() == 2
        with one_thread():
            assert workers() == 2
    assert workers() == 1


def test_tasks_run_at_the_same_time_in_order():
    """Each waits for the other: one after the other they would never end."""
    barrier = Barrier(2, timeout=20)

    def task(number):
        barrier.wait()
        return number, workers(), torch.get_num_threads()

    with one_thread():
        assert in_parallel([partial(task, 0), partial(task, 1)]) == [(0, 1, 1), (1, 1, 1)]
        assert in_parallel([]) == []
        assert in_parallel([workers]) == [2]  # a single task keeps them all


def test_without_workers_one_after_the_other_in_this_thread():
    assert in_parallel([get_ident, get_ident]) == [get_ident()] * 2


def test_an_error_of_a_task_comes_out():
    with one_thread(), pytest.raises(KeyError, match="second"):
        in_parallel([lambda: 1, partial({}.__getitem__, "second"), lambda: 3])
