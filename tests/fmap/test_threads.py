"""torchqm.fmap.threads: one thread inside, what was set before outside, also after an error."""

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from torchqm.fmap.threads import one_thread


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
