"""The logger of a run: metrics as CSV and as events of TensorBoard, in one folder."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytorch_lightning.loggers import CSVLogger
from pytorch_lightning.loggers.csv_logs import ExperimentWriter
from pytorch_lightning.loggers.logger import rank_zero_experiment
from pytorch_lightning.utilities.rank_zero import rank_zero_only
from torch import Tensor

__all__ = ["RunLogger"]


class RunLogger(CSVLogger):
    """Writes ``metrics.csv`` and, beside it, the same numbers as events that ``tensorboard --logdir`` shows.

    The folder is ``save_dir/name/version``; two loggers of Lightning would each count versions of their own. An earlier
    ``metrics.csv`` there is kept as ``metrics-1.csv`` and so on.

    Args:
        save_dir: where runs are kept.
        name: a folder in it; none if not given.
        version: of the run, a number N (``version_N``) or a folder's name; the next free number if not given.
        flush_logs_every_n_steps: how often metrics are written; at the end they always are.
        events: write events; needs tensorboard.

    Raises:
        ImportError: ``events``, and tensorboard is not installed.
    """

    def __init__(
        self,
        save_dir: str = "runs",
        name: str | None = None,
        version: int | str | None = None,
        flush_logs_every_n_steps: int = 1,
        events: bool = True,
    ) -> None:
        super().__init__(save_dir, name, version, flush_logs_every_n_steps=flush_logs_every_n_steps)
        self._events: Any = None
        self._new_events: Any = None
        if events:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError as error:
                raise ImportError(
                    f"events: need tensorboard (pip install 'torchqm[learn]', or give events=False): {error}"
                ) from error
            self._new_events = SummaryWriter

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """What writes ``metrics.csv``."""
        if self._experiment is None:
            self._experiment = _Writer(self.log_dir)
        return self._experiment

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, Tensor | float], step: int | None = None) -> None:
        """Both."""
        super().log_metrics(dict(metrics), step)
        if self._new_events is None:
            return
        if self._events is None:
            self._events = self._new_events(self.log_dir)
        for key, value in metrics.items():
            self._events.add_scalar(key, float(value), step)

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Write what is not written yet."""
        super().finalize(status)
        if self._events is not None:
            self._events.close()
            self._events = None


class _Writer(ExperimentWriter):
    """Keeps an earlier table instead of deleting it, and does not warn of the files that the run itself wrote."""

    def _check_log_dir_exists(self) -> None:
        path = Path(self.metrics_file_path)
        if not path.exists():
            return
        number = 1
        while (kept := path.with_name(f"{path.stem}-{number}{path.suffix}")).exists():
            number += 1
        path.rename(kept)
