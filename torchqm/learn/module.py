"""The matcher as a LightningModule."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

import torch
from pytorch_lightning import LightningModule
from torch import Tensor

from torchqm.learn.faults import StepError, pair_names, save_batch
from torchqm.learn.means import PairMeans, everywhere
from torchqm.learn.net import MatchNet, has_truth
from torchqm.learn.options import NetOptions
from torchqm.learn.start import start_from

__all__ = ["MatchModule"]


class MatchModule(LightningModule):
    """Trains a :class:`torchqm.learn.net.MatchNet` with Adam and logs what becomes of it.

    Logged are ``train_loss``, ``val_loss`` and ``test_loss`` with their terms (``train_l_bij`` and so on), and where
    pairs have a truth ``plain_error``, ``orbit_error`` (straight lines through space / sqrt(area), see
    :mod:`torchqm.fmap.straight_errors`), ``flipped_map`` and ``flipped_points``, after ``val_`` or ``test_``.
    Those of validation and test are means over the pairs, over all processes together; errors over the pairs that have
    a truth, and there are none where no pair has one.
    What a run reports in the end is measured by :mod:`torchqm.evaluate`.

    With a supervision some pairs of a batch, or all, may be without a truth: see :class:`torchqm.learn.net.MatchNet`. A
    run in which no training pair has one stops after its first epoch.

    A run stops where a loss, a gradient or what a layer is given is not finite: before the step is taken, so that the
    weights and all checkpoints are those of the steps before. The pairs are named, and what the step had (batch and
    weights) is kept in the run folder if the trainer has a logger: ``stopped-step-N.pt``.

    With ``Trainer(precision="bf16-mixed")`` the linear layers of the network compute in bfloat16; signatures,
    diffusion, bases, solves and losses stay in float32. It is meant for GPUs: on a CPU a step gets slower by it.

    All arguments but the last four are those of :class:`torchqm.learn.options.NetOptions`.

    Args:
        setup: ``functional_map``, ``quotient`` or ``quotient+odd``.
        supervision: ``none``, ``orbit`` or ``plain``.
        truth_form: ``spectral`` or ``assignment``.
        inputs: names of input features.
        signature: energies of a wave kernel signature, times of a heat kernel signature.
        k: eigenfunctions of the bases.
        network: ``mlp``, ``diffusion`` or ``none`` (to test what the input features alone do).
        channels: of the features.
        width: channels inside the network.
        blocks: of ``diffusion``; hidden layers of ``mlp``.
        dropout: probability.
        gradients: ``diffusion``: use products of gradients.
        rotations: ``diffusion``: let them see the orientation.
        odd_pairs: odd descriptors, at most.
        lmbda: weight of commutativity in the solver.
        tau: temperature of the soft point maps.
        w_bij: weight of bijectivity in the loss.
        w_orth: of orthogonality.
        w_lap: of commutativity.
        w_align: of the agreement of soft and functional maps.
        w_truth: of the supervision.
        lr: learning rate.
        weight_decay: of Adam (decoupled).
        seed: draws the weights and, anew in each step, what is random in it.
        start: trained weights to begin with instead of drawn ones, see :func:`torchqm.learn.start.start_from`. They are
            read when a training begins, and not again where it goes on from a checkpoint or is tested.

    Raises:
        ValueError: as :class:`torchqm.learn.options.NetOptions`.

    Example:
        >>> MatchModule(setup="quotient", k=20).hparams.setup
        'quotient'
    """

    def __init__(
        self,
        setup: str = "quotient+odd",
        supervision: str = "none",
        truth_form: str = "spectral",
        inputs: Sequence[str] = ("wks",),
        signature: int = 64,
        k: int = 60,
        network: str = "mlp",
        channels: int = 64,
        width: int = 128,
        blocks: int = 2,
        dropout: float = 0.0,
        gradients: bool = True,
        rotations: bool = False,
        odd_pairs: int = 64,
        lmbda: float = 100.0,
        tau: float = 0.07,
        w_bij: float = 1.0,
        w_orth: float = 1.0,
        w_lap: float = 1e-3,
        w_align: float = 1.0,
        w_truth: float = 1.0,
        lr: float = 1e-3,
        weight_decay: float = 0.0,
        seed: int = 0,
        start: str | None = None,
    ) -> None:
        super().__init__()
        for name, value in (("lr", lr), ("weight_decay", weight_decay)):
            if not 0 <= value <= 1e30:  # beyond it Adam's own numbers are none any more
                raise ValueError(f"{name}: {value} given, expected a number from 0 to 1e30")
        inputs = list(inputs)  # a tuple would not come back from a file as one
        self.save_hyperparameters()
        options = NetOptions(**{field.name: self.hparams[field.name] for field in fields(NetOptions)})
        with torch.random.fork_rng(devices=[]):  # the weights depend on the seed alone, not on what was drawn before
            torch.manual_seed(seed)
            self.net = MatchNet(options)
        self._begun = start is None
        self._folder: Path | None = None
        self._batch: Any = None
        self._means = PairMeans()
        # Whether a truth was in each step of the epoch; None: nobody asks, or no more.
        self._truths: list[bool] | None = None if options.supervision == "none" else []

    def begin(self) -> None:
        """Read the weights that the training begins with, once; nothing if none are given.

        Raises:
            ValueError: as :func:`torchqm.learn.start.start_from`.
        """
        if not self._begun:
            start_from(self.net, self.hparams["start"])
        self._begun = True

    def setup(self, stage: str) -> None:
        """Ask all processes for the folder now: one that fails later cannot."""
        folder = self.trainer.log_dir if self.trainer.loggers else None
        self._folder = None if folder is None else Path(folder)

    def on_fit_start(self) -> None:
        """Read the weights to begin with; a checkpoint, if the training goes on from one, has been read before."""
        self.begin()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """What comes from a checkpoint has begun; options of Adam that are not the checkpoint's hold.

        The state of the optimizer would put the old ones in their place, silently.
        """
        self._begun = True
        was = checkpoint.get("hyper_parameters", {})
        changed = {name: self.hparams[name] for name in ("lr", "weight_decay") if was.get(name) != self.hparams[name]}
        for state in checkpoint.get("optimizer_states", ()):
            for group in state["param_groups"]:
                group.update(changed)

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        """The batch with its tensors on the device; a truth stays where it is, only ``corr`` is computed with."""
        return _moved(batch, device)

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Draw anew in each step: what a run does in it does not depend on whether it was stopped before."""
        torch.manual_seed(_mixed(self.hparams["seed"], self.global_step))
        self._batch = batch

    def training_step(self, batch: Mapping[str, Any], batch_idx: int) -> Tensor:
        """The loss of a batch of pairs.

        Raises:
            StepError: it is not finite, or a layer refuses its numbers; the pairs are named.
        """
        with self._named(batch):
            terms = self.net.losses(batch)
        if self._truths is not None:
            self._truths.append(bool(has_truth(batch).any()))
        loss = self._loss(terms, batch)
        values = {f"train_{name}": value.detach() for name, value in {"loss": loss, **terms}.items()}
        self.log_dict(values, on_step=False, on_epoch=True, batch_size=len(batch["first"]["name"]), sync_dist=True)
        return loss

    def on_train_epoch_end(self) -> None:
        """Stop a supervised run that no pair supervises.

        Raises:
            StepError: none of the training pairs of all processes has a truth.
        """
        if self._truths is None:
            return
        # Of an epoch that began in its middle nothing can be said.
        whole = len(self._truths) == self.trainer.num_training_batches
        if whole and not any(everywhere(any(self._truths))):
            raise StepError(
                f"supervision: {self.hparams['supervision']!r} given, but no training pair has a truth; "
                "give others, or 'none'"
            )
        self._truths = None if whole else []

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Stop before a gradient that is not finite spoils the weights, and with them the next checkpoint.

        Raises:
            StepError: the pairs are named.
        """
        if self.trainer.precision == "16-mixed":  # there the scaler skips such a step, and goes on with a smaller scale
            return
        bad = [name for name, p in self.named_parameters() if p.grad is not None and not bool(p.grad.isfinite().all())]
        if bad:
            self._stop(f"the gradient of {', '.join(bad)} is not finite", self._batch)

    def validation_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        """Take loss and errors into the means."""
        self._measure(batch)

    def test_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        """Take loss and errors into the means."""
        self._measure(batch)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam."""
        return torch.optim.AdamW(self.parameters(), lr=self.hparams["lr"], weight_decay=self.hparams["weight_decay"])

    def on_validation_epoch_start(self) -> None:
        """Begin the means anew."""
        self._means = PairMeans()

    def on_test_epoch_start(self) -> None:
        """Begin the means anew."""
        self._means = PairMeans()

    def on_validation_epoch_end(self) -> None:
        """Log the means over the pairs of all processes."""
        self._log_means("val")

    def on_test_epoch_end(self) -> None:
        """Likewise."""
        self._log_means("test")

    def _measure(self, batch: Mapping[str, Any]) -> None:
        with self._named(batch):
            matched = self.net(batch["first"], batch["second"])
            terms = self.net.losses(batch, matched)
            errors = self.net.errors(batch, matched) if "corr" in batch["first"] else {}
        n = len(batch["first"]["name"])
        for name, value in {"loss": self._loss(terms, batch), **terms}.items():
            self._means.add(name, value.item() * n, n)
        for name, value in errors.items():
            self._means.add(name, value.sum().item(), len(value))

    def _log_means(self, stage: str) -> None:
        dtype = torch.float64 if self.dtype == torch.float64 else torch.float32
        means = {name: torch.tensor(mean, dtype=dtype) for name, mean in self._means.reduced().items()}
        # All processes have the same; Lightning wants to be told to take their mean.
        self.log_dict({f"{stage}_{name}": v.to(self.device) for name, v in means.items()}, batch_size=1, sync_dist=True)

    def _loss(self, terms: Mapping[str, Tensor], batch: Mapping[str, Any]) -> Tensor:
        loss = torch.stack(list(terms.values())).sum()
        if not bool(loss.isfinite()):
            shown = ", ".join(f"{name} {value.item():g}" for name, value in terms.items())
            self._stop(f"the loss is {loss.item():g} ({shown})", batch)
        return loss

    @contextmanager
    def _named(self, batch: Mapping[str, Any]) -> Iterator[None]:
        """Layers refuse what is not finite, and systems that rounding made singular: say at which pairs."""
        try:
            yield
        except ValueError as error:
            self._stop(str(error), batch, error)

    def _stop(self, reason: str, batch: Mapping[str, Any], cause: Exception | None = None) -> NoReturn:
        step = self.global_step
        text = f"{reason} at the pairs {', '.join(pair_names(batch))}, in step {step} of epoch {self.current_epoch}"
        if self._folder is None:
            raise StepError(text) from cause
        name = (
            f"stopped-step-{step}.pt" if self.trainer.world_size == 1 else f"stopped-step-{step}-{self.global_rank}.pt"
        )
        given = {key: value for key, value in self.hparams.items() if not key.startswith("_")}  # Lightning's own
        path = save_batch(
            self._folder / name, batch, state_dict=self.state_dict(), hparams=given, reason=reason, step=step
        )
        raise StepError(f"{text}; batch and weights are kept in {path}") from cause


def _moved(value: Any, device: torch.device) -> Any:
    if isinstance(value, Tensor):
        return value.to(device, non_blocking=True)
    return {key: _moved(part, device) for key, part in value.items()} if isinstance(value, dict) else value


def _mixed(seed: int, step: int) -> int:
    """A seed of its own for each step; runs with neighbouring seeds share none."""
    return (seed * 1_000_000_007 + step) % 2**63
