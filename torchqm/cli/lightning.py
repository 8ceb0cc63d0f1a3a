"""The LightningCLI of torchqm: which module, which data, what a run folder holds."""

import warnings

from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.cli import LightningArgumentParser, LightningCLI

from torchqm.data.datamodule import PairDataModule
from torchqm.learn.callbacks import LastEpoch, Versions
from torchqm.learn.module import MatchModule
from torchqm.learn.options import NetOptions

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
        return cls(
            MatchModule,
            PairDataModule,
            save_config_kwargs={"overwrite": True},
            seed_everything_default=0,
            args=args,
            run=run,
            auto_configure_optimizers=False,
            trainer_defaults={"callbacks": [Versions(), LastEpoch()]},
        )

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """What model and data must agree on is given once; checkpoints are kept by the orbit error."""
        parser.link_arguments("model.k", "data.k")
        parser.link_arguments("seed_everything", "model.seed")
        parser.link_arguments("seed_everything", "data.seed")
        parser.link_arguments(("model.network", "model.gradients"), "data.keys", compute_fn=_keys)
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.set_defaults(
            {
                "checkpoint.monitor": "val_orbit_error",
                "checkpoint.filename": "best-{epoch}",
                "checkpoint.mode": "min",
            }
        )


def _keys(network: str, gradients: bool) -> list[str]:
    return list(NetOptions(network=network, gradients=gradients).keys)
