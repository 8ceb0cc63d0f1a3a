"""Comparison runs: many methods on many pairs, resumed after a kill, with tables, figures and the worst pairs."""

from torchqm.benchmark.ledger import LedgerError
from torchqm.benchmark.page import write_page
from torchqm.benchmark.plan import Settings, Task, choose_methods, plan_tasks
from torchqm.benchmark.run import run_task
from torchqm.benchmark.summary import write_summary

__all__ = [
    "LedgerError",
    "Settings",
    "Task",
    "choose_methods",
    "plan_tasks",
    "run_task",
    "write_page",
    "write_summary",
]
