"""PoseModule: what every architecture shares, from the training step to the pose that it returns."""

from __future__ import annotations

import logging
import warnings
from dataclasses import asdict
from typing import ClassVar, Literal

import torch
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn

from lightning_pose.data.batches import PoseBatch, PoseDataset
from lightning_pose.data.datamodule import SceneDataModule, find_datamodule, scene_datamodule
from lightning_pose.errors import ConfigError
from lightning_pose.features import LocalExtractor
from lightning_pose.geometry.quaternions import align_hemisphere, quat_normalize
from lightning_pose.losses import LossConfig, PoseLoss
from lightning_pose.metrics.item_means import ItemMeans, key_items, key_poses
from lightning_pose.metrics.pose_metrics import PoseMetrics
from lightning_pose.models.parts.divergence import DivergenceWatch
from lightning_pose.models.parts.epoch_means import EpochMeans
from lightning_pose.models.parts.poses import Located, Pose, check_features, check_poses
from lightning_pose.models.parts.refined_module import RefinedModule
from lightning_pose.models.parts.refinement import MapSettings
from lightning_pose.models.parts.schedule import cosine_factor
from lightning_pose.models.parts.standardization import StandardizedModule
from lightning_pose.models.parts.world_frame import WorldFrame

__all__ = ["Located", "Pose", "PoseModule"]

_log = logging.getLogger("lightning_pose")

Stage = Literal["train", "val", "test"]

# Lightning notes that the module's hook is used although there is a data module, which is what is wanted.
warnings.filterwarnings("ignore", message=".*overridden `on_before_batch_transfer` in `LightningModule`")


class PoseModule(RefinedModule, StandardizedModule):
    """Base class of the architectures.

    To add one, subclass it in a file of its own, call `super().__init__(**kwargs)` first, and set `input_ranks` and
    `network`. Then export it in `models/__init__.py` and give it a config. Constructor arguments are plain types:
    they are the checkpoint's hyperparameters, and rebuild the module anywhere.

    What a subclass sets or overrides:

    | name | needed | what it is |
    |---|---|---|
    | `input_ranks` | always | how many axes `input_shape` may have |
    | `network` | always | a module whose `forward` returns (B, 7): three for the position, four for the quaternion |
    | `headline` | often | the settings that distinguish its runs, for run names and tables |
    | `feature_axis` | seldom | the axis of `input_shape` that holds the columns to standardize, if not the last |
    | `setup` | seldom | what is learnt from the training split before the first step; call `super().setup` first |
    | `decode_features` | seldom | features to poses, where that takes more than one call of `network` |
    | `decode_batch` | seldom | the same for a batch, where training differs from use |
    | `reduced_shape` | seldom | the shape of a frame's features once a fixed projection has reduced them |
    | `training_splits` | seldom | the splits whose poses end up in the weights |
    | `memory` | seldom | with `TrainingMemory`: what the checkpoint carries of every training frame |
    | `locate_images` | seldom | answers for images whose size, and perhaps camera, are known |
    | `reads_clips`, `check_data`, `training_poses`, `select_judged` | for clips | see `ClipModule` |

    With `standardize`, the seven numbers are in standard deviations around the mean training pose; otherwise they are
    metres and quaternion components. The loss always compares metres and quaternion components.

    Networks and losses see local positions, those of the world relative to an origin and a scale (`world_frame`).
    `forward`, predictions and metrics are in the world, float64. `localize_batch` converts batches before a step.

    `ClosedFormModule` is the base class for networks that are solved instead of trained in steps; `models/parts/` has
    what else several architectures share.

    Args:
        input_shape: shape of one frame's features; on the command line it follows from the data.
        loss: settings of `PoseLoss`.
        learning_rate: of Adam with decoupled weight decay, at its highest.
        weight_decay: decoupled weight decay.
        schedule: `constant`, or `cosine` decay to zero over the run, after a warm-up of 5 % of its steps.
        standardize: let the network predict in standard deviations around the mean training pose.
        standardize_features: let the network read each column of the features in standard deviations around its
            mean over the training frames. Descriptors have unit length, so that their elements are small.
        refine: build a landmark map of the same frames, whose pose a frame has where the map accepts it; `true`, or
            settings of the map.
        distance_limit: refuse images that are farther from the training images, in the features, than this times the
            farthest validation frame; null refuses none. Where a map is, it decides instead.

    Raises:
        ConfigError: `input_shape` does not suit the architecture, or a number is out of its range.
    """

    input_ranks: ClassVar[tuple[int, ...]]
    reads_clips: ClassVar[bool] = False
    """Whether features are those of clips, (B, T, *input_shape), as data modules with `gives_clips` have them."""
    network: nn.Module

    def __init__(
        self,
        input_shape: list[int],
        loss: LossConfig | None = None,
        learning_rate: float = 1e-3,
        weight_decay: float = 0.0,
        schedule: Literal["constant", "cosine"] = "cosine",
        standardize: bool = True,
        standardize_features: bool = True,
        refine: bool | MapSettings = False,
        distance_limit: float | None = 1.25,
    ) -> None:
        super().__init__()
        loss = LossConfig(**loss) if isinstance(loss, dict) else loss or LossConfig()
        self.save_hyperparameters(logger=False)  # the run's recorder logs them, with the data's
        self.hparams["loss"] = asdict(loss)  # plain types: checkpoints are read with weights_only
        self.hparams["input_shape"] = list(input_shape)
        if len(input_shape) not in self.input_ranks:
            raise ConfigError(
                f"{type(self).__name__} reads features with {' or '.join(map(str, self.input_ranks))} axes, "
                f"not of shape {tuple(input_shape)}; choose another data.extractor"
            )
        if not learning_rate > 0:
            raise ConfigError(f"learning_rate is {learning_rate}; give a number above 0, such as 0.001")
        if not weight_decay >= 0:
            raise ConfigError(f"weight_decay is {weight_decay}; give 0 or more")
        self.input_shape = tuple(input_shape)
        self.learning_rate = learning_rate
        self.weight_decay = weight_decay
        self.schedule = schedule
        self.standardize = standardize
        self.standardize_features = standardize_features
        self.loss = PoseLoss(loss)
        self.world_frame = WorldFrame(centred=not self.reads_clips)
        self.divergence = DivergenceWatch(self._name_frame)
        self._train_means = EpochMeans()
        self.val_metrics, self.val_losses = PoseMetrics(), ItemMeans()
        self.test_metrics, self.test_losses = PoseMetrics(), ItemMeans()
        self.register_scales()
        self.register_refinement(refine, distance_limit)

    @property
    def headline(self) -> str:
        """The settings that distinguish runs of this architecture, for run names and tables."""
        return "x".join(map(str, self.input_shape))

    @property
    def reduced_shape(self) -> tuple[int, ...]:
        """Shape of the numbers that a frame must be stored as for the trained layers; their size is a frame's cost."""
        return self.input_shape

    def forward(self, features: Tensor) -> Pose:
        """Features (B, *input_shape) -> poses of B frames in the world, positions in float64."""
        position, quat_raw = self.decode_features(features)
        return Pose(self.world_frame.to_world(position), quat_normalize(quat_raw))

    def decode_features(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Compute poses, as the losses of the thesis compare them.

        Args:
            features: (B, *input_shape).

        Returns:
            Local positions (B, 3) and quaternions (B, 4) not yet normalised.
        """
        return self.unscale_pose(self.network(self.standardize_input(features)))

    def decode_batch(self, batch: PoseBatch) -> tuple[Tensor, Tensor]:
        """As `decode_features`, in the steps of training, validation and test.

        For an architecture that augments features in training, or uses which frames they are of.
        """
        return self.decode_features(batch.features)

    def check_data(self, datamodule: SceneDataModule) -> None:
        """Refuse data that this architecture cannot read; the command line asks before it opens a run.

        Raises:
            ConfigError: it gives clips where images are read, or the other way round.
        """
        if self.reads_clips != datamodule.gives_clips:
            wanted, given = ("clips", "images") if self.reads_clips else ("images", "clips")
            raise ConfigError(
                f"{type(self).__name__} reads {wanted}, but {type(datamodule).__name__} gives {given}; set "
                f"data.class_path to lightning_pose.data.{wanted.title()[:-1]}DataModule"
            )

    def setup(self, stage: str) -> None:
        """Check the data, and in `fit` learn the scales of poses and features from the training split.

        Raises:
            ConfigError: as `check_data`; in `fit`, the trainer has no data module.
        """
        datamodule = scene_datamodule(self.trainer) if stage == "fit" else find_datamodule(self.trainer)
        if datamodule is not None:
            self.check_data(datamodule)
        self.attach_refinement(datamodule)
        if datamodule is not None and stage == "fit":
            train = datamodule.dataset("train")
            for split in self.training_splits:
                check_features(datamodule.dataset(split).data, isinstance(datamodule.extractor, LocalExtractor))
            self.fit_world_frame(train)
            position_m, quat_wxyz = self.training_poses(train)
            position = self.world_frame.to_local(position_m)
            self.divergence.spread_m = float((position - position.mean(0)).norm(dim=-1).mean())
            self.fit_scale(position.to(self.pose_mean), quat_wxyz.to(self.quat_reference))
            self.fit_feature_scale(train.data.features)
            if self.radius is not None:
                self.radius.set_training(train.data.features)

    def _name_frame(self, number: int) -> str:
        """The sequence and the file of a frame of the scene."""
        frame = scene_datamodule(self.trainer).scene.frames[number]
        return f"{frame.sequence}/{frame.image.name}"

    def fit_world_frame(self, train: PoseDataset) -> None:
        """Choose the origin and the scale of the positions of the training split."""
        self.world_frame.fit(train.data.position_m)

    def training_poses(self, train: PoseDataset) -> tuple[Tensor, Tensor]:
        """Positions (M, 3) and quaternions (M, 4) that the network is to return in training; they set its scale.

        Positions are in the world.
        """
        return train.targets()

    def localize_batch(self, batch: PoseBatch) -> PoseBatch:
        """The same batch with local positions, float64, as steps and losses take it."""
        return batch._replace(position_m=self.world_frame.to_local(batch.position_m))

    def on_before_batch_transfer(self, batch: PoseBatch, dataloader_idx: int) -> PoseBatch:
        batch = self.localize_batch(batch)
        return batch._replace(position_m=batch.position_m.float()) if self.device.type == "mps" else batch

    def _compare(self, batch: PoseBatch, by_item: bool) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Decode a localized batch.

        Returns:
            its loss's terms, local positions (B, ..., 3) and quaternions (B, ..., 4), not yet normalised.
        """
        position, quat_raw = self.decode_batch(batch)
        target = align_hemisphere(batch.quat_wxyz, self.quat_reference)
        truth = batch.position_m.to(position.dtype)
        return self.loss(position, quat_raw, truth, target, by_item), position, quat_raw

    def _train_step(self, batch: PoseBatch) -> Tensor:
        """The loss of a training batch, with its terms kept for `_log_training`."""
        terms, position, _ = self._compare(batch, by_item=False)
        self._train_means.add(terms, len(batch.frame))
        self.divergence.add_step(terms["total"], position, batch.position_m, batch.frame, self._remedy)
        return terms["total"]

    def _log_training(self) -> None:
        """Log the means of the loss's terms over the batches since the last time."""
        named = {_name_loss("train", name): mean for name, mean in self._train_means.take().items()}
        # Processes have as many items each, so that the mean of their means is the mean over all.
        self.log_dict(named, on_step=False, on_epoch=True, batch_size=1, sync_dist=True)

    def _judge_step(self, batch: PoseBatch, metrics: PoseMetrics, losses: ItemMeans) -> Pose:
        """The poses, in the world, of a batch of validation or test, with their errors and losses collected."""
        terms, position, quat_raw = self._compare(batch, by_item=True)
        to_world = self.world_frame.to_world
        alone = Pose(to_world(position), quat_normalize(quat_raw))
        pose = self.refine_pose(batch.frame, alone)
        check_poses(Located(batch.frame, *pose), type(self).__name__, self._remedy)
        losses.update(terms, key_items(batch.frame))
        keys = key_poses(batch.frame)
        # As poses with one column, because the judged part is cut from them likewise.
        judged = self.select_judged(Pose(keys.unsqueeze(-1), keys.unsqueeze(-1))).position_m.squeeze(-1)
        truth = self.select_judged(Pose(to_world(batch.position_m), batch.quat_wxyz))
        if metrics is self.val_metrics:
            self.add_errors(batch.features, alone, truth)
        metrics.update(*self.select_judged(pose), *truth, judged)
        return pose

    @property
    def _remedy(self) -> str:
        """What a user can do whose training diverged."""
        return f"lower model.learning_rate ({self.learning_rate:g}), or set trainer.gradient_clip_val, such as 1"

    def select_judged(self, pose: Pose) -> Pose:
        """The part of a batch's poses that metrics count; all of them, unless some are known beforehand."""
        return pose

    def training_step(self, batch: PoseBatch, batch_idx: int) -> Tensor | None:
        return self._train_step(batch)

    def on_train_batch_end(self, outputs: object, batch: PoseBatch, batch_idx: int) -> None:
        if self.trainer.is_last_batch:  # before the validation that closes the epoch
            self._log_training()

    def validation_step(self, batch: PoseBatch, batch_idx: int) -> None:
        self._judge_step(batch, self.val_metrics, self.val_losses)

    def test_step(self, batch: PoseBatch, batch_idx: int) -> Located:
        return Located(batch.frame, *self._judge_step(batch, self.test_metrics, self.test_losses))

    def predict_step(self, batch: PoseBatch, batch_idx: int) -> Located:
        pose = self.refine_pose(batch.frame, self(batch.features))
        check_poses(Located(batch.frame, *pose), type(self).__name__, self._remedy)
        return Located(batch.frame, *pose)

    def on_validation_epoch_end(self) -> None:
        self.calibrate_radius()
        self._log_metrics(self.val_metrics, self.val_losses, "val")

    def on_test_epoch_end(self) -> None:
        self._log_metrics(self.test_metrics, self.test_losses, "test")

    def on_train_epoch_end(self) -> None:
        """Refuse to go on, and to write a checkpoint, once training has diverged.

        Raises:
            ConfigError: it has.
        """
        self._log_training()  # of an epoch that ends early
        self.refit_refinement()
        self.divergence.check_epoch(self._remedy)
        self.divergence.check_weights(self.parameters(), self._remedy)

    def on_train_end(self) -> None:
        """Say so where training has ended worse than it began."""
        growth = self.divergence.describe_growth()
        if growth is not None:
            _log.warning("training has diverged: %s; %s", growth, self._remedy)

    def _log_metrics(self, metrics: PoseMetrics, losses: ItemMeans, stage: Stage) -> None:
        """Log the means over all processes, each item once.

        Raises:
            ConfigError: training has diverged.
        """
        errors = metrics.compute()
        if not self.trainer.sanity_checking:
            self.divergence.check_epoch(self._remedy)  # before this epoch's checkpoint is written
            self.divergence.check_error(errors["position_median_m"] / self.world_frame.scale, self._remedy)
        named = {_name_loss(stage, name): value for name, value in losses.compute().items()}
        # Every process has the same values, which `sync_dist` leaves as they are; without it Lightning warns.
        self.log_dict(named | {f"{stage}/{name}": value for name, value in errors.items()}, sync_dist=True)
        metrics.reset()
        losses.reset()

    def configure_optimizers(self) -> torch.optim.Optimizer | OptimizerLRSchedulerConfig:
        # Foreach kernels: one launch for all tensors, which matters for networks as small as these.
        optimizer = torch.optim.AdamW(
            self.parameters(), lr=self.learning_rate, weight_decay=self.weight_decay, foreach=True
        )
        if self.schedule == "constant":
            return optimizer
        steps = int(self.trainer.estimated_stepping_batches)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: cosine_factor(step, steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}


def _name_loss(stage: Stage, term: str) -> str:
    """The name in MLflow of a term of the loss."""
    return f"{stage}/loss" if term == "total" else f"{stage}/loss_{term}"
