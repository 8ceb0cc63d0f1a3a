"""The LightningCLI of torchqm: which module, which data, what a run folder holds."""

import warnings
from argparse import ArgumentError
from collections.abc import Iterator
from contextlib import contextmanager

from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.cli import ArgsType, LightningArgumentParser, LightningCLI
from pytorch_lightning.utilities.exceptions import MisconfigurationException

from torchqm.cli.config_errors import explained
from torchqm.cli.console import UserError
from torchqm.cli.inputs import shape_faults
from torchqm.data.datamodule import PairDataModule
from torchqm.learn.callbacks import LastEpoch, Versions
from torchqm.learn.faults import StepError
from torchqm.learn.module import MatchModule
from torchqm.learn.options import NetOptions
from torchqm.viz.callbacks import Curves, PairPictures

__all__ = ["MatchCLI"]


class MatchCLI(LightningCLI):
    """One LightningCLI for everything that learns."""

    @classmethod
    def start(cls, args: list[str], run: bool = True) -> "MatchCLI":
        """Parse and run."""
        # It fears that arguments are given twice; here those of the command line are what is passed on.
        warnings.filterwarnings("ignore", message="LightningCLI's args parameter")
        # The module moves its batches itself, since a truth in them is no tensor; it does so with other data, too.
        warnings.filterwarnings("ignore", message="You have overridden `transfer_batch_to_device`")
        once = {"exit_on_error": False}
        with shape_faults(), _stops():
            return cls(
                MatchModule,
                PairDataModule,
                save_config_kwargs={"overwrite": True},
                seed_everything_default=0,
                args=args,
                run=run,
                auto_configure_optimizers=False,
                parser_kwargs={"prog": "torchqm", **once, **{name: dict(once) for name in cls.subcommands()}},
                trainer_defaults={
                    "callbacks": [Versions(), LastEpoch(), Curves()],
                    "logger": {"class_path": "torchqm.learn.logger.RunLogger"},
                },
            )

    def parse_arguments(self, parser: LightningArgumentParser, args: ArgsType) -> None:
        """Parse.

        Raises:
            UserError: a key or a value that is wrong, in one line.
        """
        try:
            super().parse_arguments(parser, args)
        except ArgumentError as error:
            given = [str(arg) for arg in args] if isinstance(args, list) else []
            known = getattr(self, "_subcommand_parsers", {}).get(given[0] if given else "", parser)
            keys = sorted({*known.get_defaults().keys(), *(action.dest for action in known._actions)})
            raise UserError(explained(error.message, keys, given)) from error

    def instantiate_classes(self) -> None:
        """Build everything that the config names.

        Raises:
            UserError: values that do not fit, or an empty data root.
        """
        with _values():
            super().instantiate_classes()

    def before_fit(self) -> None:
        """Open the shapes and read given weights, so that a fault of the config is told from one of the code."""
        with _values():
            if self.config_init[str(self.subcommand)]["ckpt_path"] is None:
                self.model.begin()
            self.datamodule.setup("fit")

    def before_test(self) -> None:
        """Likewise."""
        with _values():
            self.datamodule.setup("test")

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """What model and data must agree on is given once; checkpoints are kept by the orbit error."""
        parser.link_arguments("model.k", "data.k")
        parser.link_arguments("seed_everything", "model.seed")
        parser.link_arguments("seed_everything", "data.seed")
        parser.link_arguments(("model.network", "model.gradients"), "data.keys", compute_fn=_keys)
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.add_lightning_class_args(PairPictures, "pictures")
        parser.set_defaults(
            {
                "checkpoint.monitor": "val_orbit_error",
                "checkpoint.filename": "best-{epoch}",
                "checkpoint.mode": "min",
            }
        )


def _keys(network: str, gradients: bool) -> list[str]:
    return list(NetOptions(network=network, gradients=gradients).keys)


@contextmanager
def _values() -> Iterator[None]:
    """Values of a config that do not fit are the user's to put right; so is a package that is not there."""
    try:
        yield
    except (ValueError, OSError, ImportError, MisconfigurationException) as error:
        raise UserError(str(error)) from error


@contextmanager
def _stops() -> Iterator[None]:
    """A run that cannot go on is told in one line; every other exception is a bug and keeps its traceback."""
    try:
        yield
    except (StepError, MisconfigurationException) as error:
        raise UserError(str(error)) from error
