"""torchqm.cli.threads: one thread, for libraries that are loaded and for those to come."""

import os

import torch
from threadpoolctl import threadpool_info

from torchqm.cli.threads import THREAD_VARIABLES, limit_to_one_thread


def test_one_thread(monkeypatch):
    for name in THREAD_VARIABLES:
        monkeypatch.setenv(name, "8")
    torch.set_num_threads(2)
    try:
        limit_to_one_thread()
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(1)  # as conftest has it
    assert {os.environ[name] for name in THREAD_VARIABLES} == {"1"}
    assert {library["num_threads"] for library in threadpool_info()} == {1}
