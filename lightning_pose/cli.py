"""PoseCLI: LightningCLI for fit, validate, test and predict, with the project's defaults and resuming."""

from __future__ import annotations

import argparse
import contextlib
import json
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np
import torch
import yaml
from lightning import Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.utilities.exceptions import SIGTERMException

from lightning_pose.checkpoint import check_specs, find_class_paths, read_checkpoint
from lightning_pose.commands.config_parser import ALLOW_HELP, PoseParser, parser_settings, rename_value
from lightning_pose.commands.setting_errors import REMEDY, explain_setting_error
from lightning_pose.concurrency.tasks import SCHEDULER_HELP
from lightning_pose.data import SceneDataModule, require_clips
from lightning_pose.errors import ConfigError
from lightning_pose.evaluation.callback import TestReport
from lightning_pose.evaluation.gather import gather_poses
from lightning_pose.evaluation.images import match_rows
from lightning_pose.evaluation.unseen import keep_unseen_frames
from lightning_pose.localization.sequences import chain_test_split
from lightning_pose.models import PoseModule
from lightning_pose.models.parts.poses import Located, check_poses
from lightning_pose.paths import default_tracking_uri
from lightning_pose.runs.checkpoints import BestCheckpoint, LastCheckpoint, checkpoint_folder
from lightning_pose.runs.clock import TrainingClock
from lightning_pose.runs.epoch_bar import EpochBar
from lightning_pose.runs.last_run import find_last_run
from lightning_pose.runs.lightning_messages import filter_messages
from lightning_pose.runs.recorder import RunRecorder
from lightning_pose.runs.resume import check_architecture, check_resumable, check_same_settings, is_complete, read_seed
from lightning_pose.scenes.trajectory_files import write_sequences

__all__ = ["PoseCLI", "main"]


SCENES = ("root", "train_scenes")
"""Settings of the data modules that say what a run trains on."""

COUNTS = ("accumulate_grad_batches", "check_val_every_n_epoch", "log_every_n_steps")
"""Settings of the trainer that are 1 or more; Lightning divides by them without a check."""


SECTIONS = ("trainer", "best", "report")
"""Parts of a config whose settings have defaults; a line `trainer:` with nothing below means none."""


class PoseCLI(LightningCLI):
    """`python -m lightning_pose fit | validate | test | predict`.

    Args:
        args: the command line, verb first; without the verb if `run` is False.
        run: run the verb; otherwise only build what the config describes.
    """

    def __init__(self, args: list[str], run: bool = True) -> None:
        filter_messages()
        self.recorder = RunRecorder()
        self.last = LastCheckpoint()
        self._verb = args[0] if run else None
        self._checkpoint: str | None = None
        super().__init__(
            model_class=PoseModule,
            datamodule_class=SceneDataModule,
            subclass_mode_model=True,
            subclass_mode_data=True,
            save_config_callback=None,  # it asserts with a database logger; the recorder keeps the config
            trainer_defaults={
                # The recorder comes first: a run has its name and tags before anything else can fail.
                "callbacks": [self.recorder, TrainingClock(), self.last, EpochBar()],
                "logger": {"class_path": "lightning_pose.runs.logger.MLflowLogger"},
                "default_root_dir": "mlruns",
                "enable_model_summary": False,
                "log_every_n_steps": 1,
            },
            seed_everything_default=0,
            auto_configure_optimizers=False,
            load_from_checkpoint_support=False,  # checkpoints carry their own plain settings
            parser_class=PoseParser,
            parser_kwargs={args[0]: parser_settings(args[0])} if run else parser_settings("extract"),
            args=_with_saved_config(args) if run else _require_config("extract", args),
            run=run,
        )

    def subcommands(self) -> dict[str, set[str]]:
        """The verb that is run, and what its parser skips; Lightning would prepare the parsers of all four."""
        return {verb: skipped for verb, skipped in LightningCLI.subcommands().items() if verb == self._verb}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        self.settings_parser = parser
        parser.link_arguments("data.input_shape", "model.init_args.input_shape", apply_on="instantiate")
        parser.add_lightning_class_args(BestCheckpoint, "best")
        parser.add_lightning_class_args(TestReport, "report")
        if str(parser.prog).endswith("extract"):
            parser.add_argument("--scheduler", type=str | None, help=SCHEDULER_HELP)
        elif not str(parser.prog).endswith("fit"):
            parser.add_argument("--allow", action="append", help=ALLOW_HELP)

    def parse_arguments(self, parser: LightningArgumentParser, args: list[str]) -> None:
        try:
            # Not Lightning's own, which warns that sys.argv is given as well.
            self.config = parser.parse_args([rename_value(word) for word in args])
        except UnicodeDecodeError as error:
            raise ConfigError(f"the config is not text ({error}); give a YAML file") from error
        config = self.config[self.config.subcommand] if "subcommand" in self.config else self.config
        for name in SECTIONS:
            if name in config and config[name] is None:
                raise ConfigError(f"{name} has no settings; give some, or leave its line out of the config")
        if "subcommand" in self.config:
            # Lightning would read a checkpoint named here, and add its hyperparameters to the config.
            # `_with_saved_config` has added them already, so the name is put aside until then.
            self._checkpoint, config.ckpt_path = config.ckpt_path, None

    def instantiate_classes(self) -> None:
        try:
            super().instantiate_classes()
        except ValueError as error:
            # jsonargparse wraps what a constructor refuses; the constructor's own words are among its lines.
            if str(error).startswith("Does not validate"):
                raise ConfigError(explain_setting_error(str(error))) from error
            raise
        self.model.check_data(self.datamodule)
        if self.subcommand == "fit" and self.config.fit.ckpt_path is not None:
            specs = self.model.describe(), self.datamodule.describe()
            check_same_settings(self.config.fit.ckpt_path, *specs, read_seed(), self.trainer.precision)

    def before_instantiate_classes(self) -> None:
        if self.subcommand is not None:
            self.config[self.subcommand].ckpt_path = self._checkpoint
        if self.subcommand in ("validate", "predict"):
            self.config[self.subcommand].trainer.logger = False  # a look at a checkpoint is no run
        elif self.subcommand == "test":
            self.config.test.verbose = False  # the report prints a better table
        elif self.subcommand == "fit" and self.config.fit.ckpt_path is not None:
            if self.config.fit.ckpt_path == "last":
                self._continue_last_run()
            config = self.config.fit
            check_resumable(config.ckpt_path, config.model.class_path, config.trainer.max_epochs, self.last.finishes)

    def _continue_last_run(self) -> None:
        config = self.config.fit
        logger = config.trainer.logger
        if not logger:
            raise ConfigError("trainer.logger is off, so no run is known; name the checkpoint in --ckpt_path")
        uri = logger.init_args.tracking_uri or default_tracking_uri(logger.init_args.root)
        run_id, checkpoint = find_last_run(
            uri=uri,
            experiment_name=logger.init_args.experiment_name,
            checkpoints=Path(config.trainer.default_root_dir) / "checkpoints",
            architecture=config.model.class_path.rpartition(".")[2],
            data={name: config.data.init_args[name] for name in SCENES if name in config.data.init_args},
        )
        logger.init_args.run_id = run_id
        self.last.finishes = not is_complete(uri, run_id)
        config.ckpt_path = str(checkpoint)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        config = self.config if self.subcommand is None else self.config[self.subcommand]
        for name in COUNTS:
            count = config.trainer[name]
            if count is not None and count < 1:
                raise ConfigError(f"trainer.{name} is {count}; give 1 or more")
        self.recorder.config_yaml = self.settings_parser.dump(config, skip_unset=False)
        return super().instantiate_trainer(**kwargs)

    def after_fit(self) -> None:
        """Test the best checkpoint, in the same run; without one, after no epoch or a trial run, the model as it is."""
        best = checkpoint_folder(self.trainer) / "best.ckpt"
        # Other processes than the first do not know the run, nor its folder.
        checkpoint = self.trainer.strategy.broadcast(str(best) if best.is_file() else None)
        self.trainer.test(self.model, datamodule=self.datamodule, ckpt_path=checkpoint, verbose=False)

    def validate(self, model: PoseModule, datamodule: SceneDataModule, **kwargs: Any) -> None:
        """Measure the model on validation frames that it has not learnt from.

        Raises:
            DataError: it has learnt from all of them.
        """
        left_out = keep_unseen_frames(read_checkpoint(kwargs["ckpt_path"]), model, datamodule)
        self.trainer.validate(model, datamodule=datamodule, **kwargs)
        if left_out and self.trainer.is_global_zero:
            print(f"{left_out} validation frames are left out: the model has learnt from them")

    def predict(self, model: PoseModule, datamodule: SceneDataModule, **kwargs: Any) -> None:
        """Write one TUM file a sequence of the test split; refused frames are comments there.

        Raises:
            DataError: poses are not finite numbers.
        """
        scene = datamodule.scene
        if model.reads_clips:
            datamodule.prepare_data()
            model.load_state_dict(read_checkpoint(kwargs["ckpt_path"])["state_dict"])
            chained = chain_test_split(model, require_clips(datamodule))
            rows, *poses = (torch.cat(parts) for parts in zip(*chained, strict=True))
            located = Located(datamodule.dataset("test").data.frame[rows], *poses)
            check_poses(located, type(model).__name__, "check the checkpoint and the images")
        else:
            located = gather_poses(cast(list[Located], self.trainer.predict(model, datamodule=datamodule, **kwargs)))
        if not self.trainer.is_global_zero:
            return
        frames = [scene.frames[i] for i in located.frame.tolist()]
        folder = Path(self.trainer.default_root_dir) / "predictions" / f"{type(model).__name__}-{scene.name}"
        refused = np.zeros(len(frames), bool)
        if not model.reads_clips:
            test = datamodule.dataset("test")
            refused = model.find_refused(test.__getitems__(match_rows(test.data.frame, located.frame).tolist()))
        for file in write_sequences(folder, frames, located.position_m.numpy(), located.quat_wxyz.numpy(), refused):
            print(file)
        if refused.any():
            print(f"{refused.sum()} of {len(refused)} frames are refused, and have no pose there")


class _OptionParser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message}; {REMEDY}")


def _with_saved_config(args: list[str]) -> list[str]:
    """Put the checkpoint's own settings into the command line of a verb that only reads it.

    Its architecture replaces the config's, which may have other widths. Its data settings are used if no config is
    given. Options on the command line have precedence.
    """
    parser = _OptionParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--ckpt_path")
    parser.add_argument("--config", "-c", action="append", default=[])
    parser.add_argument("--allow", action="append", default=[])
    options, rest = parser.parse_known_args(args[1:])
    asks = any(word == "-h" or "help" in word or word.startswith("--print_config") for word in rest)
    if asks:
        return args
    if args[0] == "fit":
        return _require_config("fit", args)
    if options.ckpt_path is None:
        raise ConfigError(f"{args[0]} needs a checkpoint; give it with --ckpt_path")
    named = [*options.allow, *_list_named_classes(options.config, rest)]
    saved = check_specs(read_checkpoint(options.ckpt_path)["lightning_pose"], named)
    model, data = saved["model"], saved["data"]
    assert model is not None
    for file in options.config:
        check_architecture(options.ckpt_path, model["class_path"], _architecture_of(file))
    model["init_args"].pop("input_shape", None)  # it follows from the data
    settings = {"model": model} | ({} if options.config or data is None else {"data": data})
    configs = [word for text in (*options.config, json.dumps(settings)) for word in ("--config", text)]
    return [args[0], *configs, *rest, "--ckpt_path", options.ckpt_path]


def _require_config(verb: str, args: list[str]) -> list[str]:
    """The command line, if it gives a config, an architecture and data, or asks for help.

    Raises:
        ConfigError: it does not, so that no other option can be understood.
    """
    names = {word.partition("=")[0] for word in args}
    asks = any(word == "-h" or "help" in word or word.startswith("--print_config") for word in args)
    if not asks and not names & {"--config", "-c"} and not {"--model", "--data"} <= names:
        raise ConfigError(
            f"{verb} needs a config, which says what to train and on which data; give one with --config, such as "
            "configs/quickstart.yaml, or configs/surf_lstm.yaml with --data.root DIR"
        )
    return args


def _list_named_classes(configs: list[str], words: list[str]) -> list[str]:
    """The class paths in config files and in the words of a command line, which the user trusts by naming them."""
    settings: list[object] = []
    for word, following in pairwise([*words, ""]):
        name, equals, value = word.partition("=")
        settings.append({name.rpartition(".")[2].lstrip("-"): value if equals else following})
    for file in configs:
        with contextlib.suppress(OSError, UnicodeDecodeError, yaml.YAMLError):  # the parser says what is wrong with it
            settings.append(yaml.safe_load(Path(file).read_text()))
    return find_class_paths(settings)


def _architecture_of(config: str) -> str | None:
    """The class path of a config file's model, if it has one."""
    try:
        return yaml.safe_load(Path(config).read_text())["model"]["class_path"]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
        return None  # the parser says what is wrong with it


def main(argv: list[str]) -> int:
    """Run one of LightningCLI's verbs, `argv` begins with it; return the exit code.

    Raises:
        KeyboardInterrupt: a signal has ended it.
    """
    try:
        PoseCLI(argv)
    except SystemExit as stop:
        # Lightning turns Ctrl-C into exit code 1, once it has closed the run; its own for SIGTERM has none.
        if stop.code == 1 or isinstance(stop, SIGTERMException):
            raise KeyboardInterrupt("`fit --ckpt_path last`, with the same settings, goes on") from stop
        raise
    return 0
