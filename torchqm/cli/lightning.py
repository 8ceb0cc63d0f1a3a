"""The LightningCLI of torchqm: which module, which data, what a run folder holds."""

import sys
import warnings
from argparse import ArgumentError
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

import yaml
from pytorch_lightning import Callback, Trainer
from pytorch_lightning.cli import ArgsType, LightningArgumentParser, LightningCLI

from torchqm.cli.agreement import check_monitor, check_truth, first_truths
from torchqm.cli.config_errors import explained
from torchqm.cli.config_faults import stops, value_faults
from torchqm.cli.console import UserError
from torchqm.cli.inputs import shape_faults
from torchqm.cli.learn import Interrupted
from torchqm.cli.run_folder import Place, RunConfig, hold, place_of_test, place_of_training, read_config
from torchqm.data.datamodule import PairDataModule
from torchqm.learn.callbacks import BestCheckpoint, LastEpoch, Versions
from torchqm.learn.logger import RunLogger
from torchqm.learn.module import MatchModule
from torchqm.learn.options import NetOptions
from torchqm.learn.state import TrainingState, check_state
from torchqm.viz.callbacks import Curves, PairPictures

__all__ = ["MatchCLI", "own_callbacks"]

_ABOUT = {
    "fit": "Train a matcher. 'torchqm fit --resume RUN' goes on with the training in the folder RUN, with its "
    "config.yaml; options that follow change it. --ckpt_path FILE begins a run in a new folder from the state in FILE, "
    "but goes on in RUN where FILE is RUN/checkpoints/last.ckpt and the config is that of RUN.",
    "test": "Test a matcher. 'torchqm test RUN' takes config.yaml and the best checkpoint (else the last) of the run "
    "folder RUN; options that follow change it. It writes to RUN/test/version_N.",
}


def own_callbacks() -> list[Callback]:
    """What every run has beside the callbacks with options of their own; those of a config are added to them."""
    return [Versions(), LastEpoch(), Curves()]


class MatchCLI(LightningCLI):
    """One LightningCLI for everything that learns.

    What the command line says about places is decided here, before anything is written: a training that goes on does so
    in its own folder, a test writes into a folder of its own, and a checkpoint is looked at first.
    """

    def __init__(
        self, *args: Any, held: ExitStack, resumed: Path | None = None, words: Sequence[str] = (), **kwargs: Any
    ) -> None:
        self._held, self._resumed, self._words = held, resumed, words
        self._place: Place | None = None
        self._state: TrainingState | None = None
        super().__init__(*args, **kwargs)  # this does everything

    @classmethod
    def start(cls, args: list[str], run: bool = True, resume: Path | None = None) -> "MatchCLI":
        """Parse and run; ``resume`` is the folder of a run to go on with, whose config is among the arguments."""
        # It fears that arguments are given twice; here those of the command line are what is passed on.
        warnings.filterwarnings("ignore", message="LightningCLI's args parameter")
        # The module moves its batches itself, since a truth in them is no tensor; it does so with other data, too.
        warnings.filterwarnings("ignore", message="You have overridden `transfer_batch_to_device`")
        # Its own checkpoints, where a run goes on in its folder.
        warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")
        once = {"exit_on_error": False, "allow_abbrev": False}
        with shape_faults(), stops(args), ExitStack() as held:
            return cls(
                MatchModule,
                PairDataModule,
                held=held,
                save_config_callback=RunConfig,
                seed_everything_default=0,
                args=args,
                resumed=resume,
                words=args,
                run=run,
                auto_configure_optimizers=False,
                parser_kwargs={
                    "prog": "torchqm",
                    **once,
                    **{name: {"description": text, **once} for name, text in _about(args).items()},
                },
                trainer_defaults={
                    "callbacks": own_callbacks(),
                    "logger": {"class_path": "torchqm.learn.logger.RunLogger"},
                },
            )

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]  # Lightning asks the object, too
        """Those that there is a module and data for."""
        return {name: found for name, found in LightningCLI.subcommands().items() if name in _about(self._words)}

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
            raise UserError(explained(error.message, _keys_of(known), given)) from error

    def _parse_ckpt_path(self) -> None:
        """Nothing: Lightning would put the options of a checkpoint, whatever file it is, before those of the config."""

    def instantiate_classes(self) -> None:
        """Build everything that the config names.

        Raises:
            UserError: values that do not fit, or an empty data root.
        """
        with self._values():
            super().instantiate_classes()

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Look at the checkpoint, and choose the folder.

        Raises:
            UserError: a checkpoint that is not there, damaged, or of another architecture.
        """
        self._agree()
        if self.subcommand is None:
            return self._trainer(**kwargs)
        given = self.config_init[self.subcommand]
        if given["weights_only"] is False:
            raise UserError(
                "weights_only: false given; nothing in a checkpoint is executed, so that true alone is allowed"
            )
        asked = given["ckpt_path"], given["trainer"]["logger"], self._words
        if self.subcommand == "test":
            place = place_of_test(*asked)
        else:
            place = place_of_training(*asked, self._resumed, self._same_run)
        if place.checkpoint is not None:
            fits = self.model.hparams, self.model.state_dict()
            self._state = check_state(place.checkpoint, *fits, training=self.subcommand == "fit")
        if place.folder is not None:
            self.config[self.subcommand]["ckpt_path"] = read_config(place.folder).get("ckpt_path")
            self._get(self.config_init, "checkpoint").return_to_folder(place.goes_on)
            if self._state is not None and place.goes_on:
                place = place.at(self._state.steps)
        given["ckpt_path"], given["weights_only"], self._place = place.checkpoint, True, place
        return self._trainer(**kwargs, logger=place.loggers)

    def _agree(self) -> None:
        """Find what would stop the first epoch, or the end of it."""
        options = self.model.hparams
        check_truth(self.datamodule.hparams["truth"], options["supervision"])
        if self.subcommand != "test" and not self._get(self.config, "trainer.callbacks"):  # others log for themselves
            check_monitor(self._get(self.config, "checkpoint.monitor"), options)

    def _run_subcommand(self, subcommand: str) -> None:
        try:
            super()._run_subcommand(subcommand)
        except SystemExit as stop:
            if stop.code != 1:  # Lightning's answer to an interrupt, after the callbacks have had their say
                raise
            folder = getattr(self.trainer.logger, "log_dir", None) if subcommand == "fit" else None
            raise Interrupted(folder) from stop

    def _values(self, option: str = "") -> AbstractContextManager[None]:
        """Values of a config that do not fit are told with their option, else with this one."""

        def keys() -> list[str]:
            return _keys_of(self.parser if self.subcommand is None else self._parser(self.subcommand))

        return value_faults(self._words, keys, option)

    def _set_seed(self) -> None:
        with self._values("seed_everything"):
            super()._set_seed()

    def _trainer(self, **kwargs: Any) -> Trainer:
        try:
            with self._values("trainer"):
                return super().instantiate_trainer(**kwargs)
        except UserError as error:
            if "stateful callback" not in str(error):
                raise
            name = str(error).split("`")[1]
            raise UserError(
                f"trainer.callbacks: {name} is there twice with the same options; one comes with every run, and its "
                "options are those of 'checkpoint'"
            ) from error

    def _same_run(self, folder: Path) -> bool:
        """Whether the config is that of a run folder, in all that decides what is trained."""
        dumped = self._parser(self.subcommand).dump(self.config[str(self.subcommand)], skip_none=False)
        ours, theirs = yaml.safe_load(dumped), read_config(folder)
        return all(ours.get(name) == theirs.get(name) for name in ("model", "data", "seed_everything"))

    def before_fit(self) -> None:
        """Open the shapes and read given weights, so that a fault of the config is told from one of the code."""
        with self._values():
            if self.config_init[str(self.subcommand)]["ckpt_path"] is None:
                self.model.begin()
            self.datamodule.setup("fit")
            first_truths(self.datamodule, "train", "validation")
            if self.datamodule.parts["validation"] is not None and self.trainer.limit_val_batches:
                own = self._get(self.config_init, "trainer.callbacks")
                truth = self.datamodule.hparams["truth"] != "none"
                if not own:
                    check_monitor(self._get(self.config, "checkpoint.monitor"), self.model.hparams, truth)
        if not self.trainer.is_global_zero:
            return
        logger = next((logger for logger in self.trainer.loggers if isinstance(logger, RunLogger)), None)
        if logger is not None:
            self._held.enter_context(hold(Path(logger.log_dir)))
        if self._place is not None and (text := self._place.news(self._state, self.trainer.max_epochs)):
            print(f"torchqm: {text}", file=sys.stderr)

    def before_test(self) -> None:
        """Likewise."""
        with self._values():
            self.datamodule.setup("test")
            first_truths(self.datamodule, "test")

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """What model and data must agree on is given once; checkpoints are kept by the orbit error."""
        parser.link_arguments("model.k", "data.k")
        parser.link_arguments("seed_everything", "model.seed")
        parser.link_arguments("seed_everything", "data.seed")
        parser.link_arguments(("model.network", "model.gradients"), "data.keys", compute_fn=_keys)
        parser.add_lightning_class_args(BestCheckpoint, "checkpoint")
        parser.add_lightning_class_args(PairPictures, "pictures")
        parser.set_defaults(
            {
                "checkpoint.monitor": "val_orbit_error",
                "checkpoint.filename": "best-{epoch}",
                "checkpoint.mode": "min",
            }
        )


def _about(words: Sequence[str]) -> dict[str, str]:
    """What each subcommand does; the one that is called alone, since making the parser of one takes a while."""
    return {name: text for name, text in _ABOUT.items() if name in words[:1]} or _ABOUT


def _keys_of(parser: Any) -> list[str]:
    return sorted({*parser.get_defaults().keys(), *(action.dest for action in parser._actions)})


def _keys(network: str, gradients: bool) -> list[str]:
    return list(NetOptions(network=network, gradients=gradients).keys)
