"""The logger of a run: metrics as CSV and as events of TensorBoard, in one folder."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytorch_lightning.loggers import CSVLogger
from pytorch_lightning.loggers.csv_logs import ExperimentWriter
from pytorch_lightning.loggers.logger import rank_zero_experiment
from pytorch_lightning.utilities.rank_zero import rank_zero_only
from torch import Tensor

from torchqm.geometry.files import write_whole
from torchqm.learn.run_files import set_aside

__all__ = ["RunLogger"]


class RunLogger(CSVLogger):
    """Writes ``metrics.csv`` and, beside it, the same numbers as events that ``tensorboard --logdir`` shows.

    The folder is ``save_dir/name/version``; two loggers of Lightning would each count versions of their own. An earlier
    ``metrics.csv`` there is kept as ``metrics-1.csv`` and so on, unless :meth:`moved` says that it is gone on with.

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
        self._steps: int | None = None
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
            self._experiment = _Writer(self.log_dir, self._steps)
        return self._experiment

    def moved(self, save_dir: Path, version: str | None, steps: int | None = None) -> "RunLogger":
        """A logger with the same options for another folder.

        Args:
            save_dir: where runs are kept.
            version: folder of the run in it; the next free ``version_N`` if not given.
            steps: go on after so many: earlier rows are kept, later ones, which will be computed again, are dropped.
        """
        events = self._new_events is not None
        other = RunLogger(str(save_dir), None, version, self._flush_logs_every_n_steps, events)
        other._steps = steps
        return other

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, Tensor | float], step: int | None = None) -> None:
        """Both."""
        super().log_metrics(dict(metrics), step)
        if self._new_events is None:
            return
        if self._events is None:
            self._events = self._new_events(self.log_dir, purge_step=self._steps)
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

    def __init__(self, log_dir: str, steps: int | None) -> None:
        self._steps = steps
        super().__init__(log_dir)

    def _check_log_dir_exists(self) -> None:
        path = Path(self.metrics_file_path)
        if not path.exists():
            return
        if self._steps is None:
            set_aside(path)
            return
        columns, rows = _read(path)
        self.metrics_keys = columns
        _write(path, columns, [row for row in rows if float(row["step"]) < self._steps])

    def _rewrite_with_new_header(self, fieldnames: list[str]) -> None:
        """As Lightning does it, but a kill in the midst of it loses no row."""
        path = Path(self.metrics_file_path)
        _write(path, fieldnames, _read(path)[1])


def _read(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and whole rows; a kill may have left half of the last one."""
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        rows = [row for row in reader if None not in row and None not in row.values()]
    return list(reader.fieldnames or []), rows


def _write(path: Path, columns: list[str], rows: list[dict[str, str]]) -> None:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns)
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, lambda file: file.write(text.getvalue().encode()))
