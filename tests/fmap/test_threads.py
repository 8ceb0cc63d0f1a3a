"""torchqm.fmap.threads: one thread inside, what was set before outside, also after an error."""

from functools import partial
from threading import Barrier, Event, Lock, Thread, active_count, get_ident
from time import sleep

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from torchqm.fmap.threads import in_parallel, in_shares, one_thread, shares, threads_as_before, workers


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
        assert in_parallel([partial(task, 0), partial(task, 1)]) == [(0, 2, 1), (1, 2, 1)]
        assert in_parallel([]) == []
        assert in_parallel([workers]) == [2]


def test_without_workers_one_after_the_other_in_this_thread():
    assert in_parallel([get_ident, get_ident]) == [get_ident()] * 2


def test_a_thread_that_is_done_helps_with_the_task_that_is_left():
    """The parts of the long task wait for each other: with one thread left to it they would never end."""
    met, done = Barrier(2, timeout=20), Event()

    def short():
        done.set()
        return get_ident()

    def long():
        assert done.wait(20)
        return in_parallel([met.wait, met.wait])

    for tasks in ([short, long], [long, short]):
        done.clear()
        with one_thread():
            found = in_parallel(tasks)
        assert sorted(found[tasks.index(long)]) == [0, 1]


def test_tasks_that_nobody_had_time_for_are_taken_when_somebody_has():
    """The parts are handed out while the other thread is busy, and wait for each other."""
    met, begun, may_end = Barrier(2, timeout=20), Event(), Event()

    def other():
        begun.set()
        assert may_end.wait(20)

    def parts():
        assert begun.wait(20)
        return in_parallel([lambda: may_end.set() or met.wait(), met.wait])

    with one_thread():
        assert sorted(in_parallel([parts, other])[0]) == [0, 1]


def test_never_more_threads_than_there_were():
    running, most, lock = [0], [0], Lock()

    def leaf(number):
        with lock:
            running[0] += 1
            most[0] = max(most[0], running[0])
        sleep(0.002)
        with lock:
            running[0] -= 1
        return number

    def branch(number):
        return in_parallel([partial(leaf, 4 * number + i) for i in range(4)])

    torch.set_num_threads(3)
    with one_thread():
        found = in_parallel([partial(branch, number) for number in range(5)])
    assert [number for part in found for number in part] == list(range(20))
    assert most[0] == 3
    assert running[0] == 0


def test_helpers_have_the_gradient_mode_of_the_caller():
    met, weight = Barrier(2, timeout=20), torch.ones(2, requires_grad=True)

    def task():
        met.wait()
        return (2 * weight).requires_grad, torch.is_inference_mode_enabled()

    with one_thread():
        assert in_parallel([task, task]) == [(True, False)] * 2
        with torch.no_grad():
            assert in_parallel([task, task]) == [(False, False)] * 2
        with torch.inference_mode():
            assert in_parallel([task, task]) == [(False, True)] * 2


def test_helpers_end_with_the_region():
    before = active_count()
    with one_thread():
        in_parallel([get_ident] * 4)
        assert active_count() == before + 1
    assert active_count() == before


def test_of_several_errors_the_first_and_nothing_is_begun_after_it():
    met, begun = Barrier(2, timeout=20), []

    def fail(number):
        begun.append(number)
        if number < 2:
            met.wait()  # both are running when the first error comes
        raise KeyError(f"task {number}")

    with one_thread(), pytest.raises(KeyError, match="task 0"):
        in_parallel([partial(fail, number) for number in range(50)])
    assert len(begun) <= 3  # the third where one of the two was quick


def test_an_error_of_a_task_comes_out():
    with one_thread(), pytest.raises(KeyError, match="second"):
        in_parallel([lambda: 1, partial({}.__getitem__, "second"), lambda: 3])


def test_shares_run_at_the_same_time_without_gradients_and_on_one_thread_each():
    met, seen, kept = Barrier(2, timeout=10), [], torch.ones(2, requires_grad=True)

    def run(items):
        met.wait()  # ends only if two run at the same time
        seen.append((list(items), torch.get_num_threads(), (2 * kept).requires_grad, get_ident()))

    in_shares(run, range(5), 2)
    assert sorted(items for items, *_ in seen) == [[0, 2, 4], [1, 3]]
    assert [row[1:3] for row in seen] == [(1, False)] * 2
    assert len({get_ident(), *(row[3] for row in seen)}) == 3
    assert torch.get_num_threads() == 2


def test_an_error_of_a_share_comes_out_and_threads_are_as_before():
    def run(items):
        raise KeyError(f"share of {list(items)}")

    with pytest.raises(KeyError, match=r"share of \[0\]"):
        in_shares(run, range(2), 2)
    assert torch.get_num_threads() == 2


def test_one_share_is_run_here():
    seen = []
    in_shares(lambda items: seen.append((list(items), get_ident())), range(3), 1)
    assert seen == [([0, 1, 2], get_ident())]


def test_others_have_the_threads_that_were_there_before():
    outside = blas()
    with one_thread():
        with threads_as_before():
            assert (torch.get_num_threads(), blas(), workers()) == (2, outside, 1)
            with one_thread():  # what others call may be this package again
                assert (torch.get_num_threads(), set(blas()), workers()) == (1, {1}, 2)
            assert (torch.get_num_threads(), blas()) == (2, outside)
        assert (torch.get_num_threads(), set(blas()), workers()) == (1, {1}, 2)
    assert (torch.get_num_threads(), blas()) == (2, outside)
    with threads_as_before():
        assert (torch.get_num_threads(), blas()) == (2, outside)
    with pytest.raises(KeyError), one_thread(), threads_as_before():
        raise KeyError
    assert (torch.get_num_threads(), blas(), workers()) == (2, outside, 1)


def test_two_threads_of_python_inside_at_the_same_time():
    """The first to come is the first to go: the second still has one, and the last leaves what the first has found."""
    outside, entered, leave, seen = blas(), Event(), Event(), []

    def other():
        torch.set_num_threads(2)
        with one_thread():
            entered.set()
            leave.wait(20)
            seen.append(set(blas()))
        seen.append(torch.get_num_threads())

    thread = Thread(target=other)
    with one_thread():
        thread.start()
        assert entered.wait(20)
    leave.set()
    thread.join(20)
    assert seen == [{1}, 2]
    assert blas() == outside
    assert torch.get_num_threads() == 2


def test_new_threads_have_as_many_as_before_when_the_last_has_left():
    """Torch's number is copied by new threads: the second to come must not take the first one's for its own."""
    inside, entered, seen = [], [Event(), Event()], []

    def first():
        with one_thread():
            entered[0].set()
            entered[1].wait(20)

    def second():
        entered[0].wait(20)
        with one_thread():
            inside.append(workers())
            entered[1].set()
            sleep(0.1)

    threads = [Thread(target=run) for run in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    new = Thread(target=lambda: seen.append(torch.get_num_threads()))
    new.start()
    new.join(20)
    assert (inside, seen) == ([2], [2])


def test_also_in_a_thread_that_is_not_the_main_one():
    seen = []

    def inside():
        with one_thread():
            seen.append((torch.get_num_threads(), set(blas())))
        seen.append((torch.get_num_threads(), set(blas())))

    thread = Thread(target=inside)
    thread.start()
    thread.join(20)
    assert seen == [(1, {1}), (2, set(blas()))]
    with threadpool_limits(1, "blas"):  # the right to set it is not taken from others for good
        assert set(blas()) == {1}


@pytest.mark.parametrize("n", [0, 1, 3, 10, 11])
def test_shares_are_all_things_in_order(n):
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with one_thread():
            parts = shares(n)
    finally:
        torch.set_num_threads(before)
    assert [i for part in parts for i in range(n)[part]] == list(range(n))
    assert len(parts) == min(3, n)
