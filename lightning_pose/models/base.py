"""PoseModule: what every architecture shares, from the training step to the pose it answers with."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from lightning import LightningModule
from torch import Tensor, nn

from lightning_pose.checkpoint import Spec, class_path, resolve_class_path
from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import CheckpointError, ConfigError
from lightning_pose.geometry.quaternions import align_hemisphere, mean_quat, quat_normalize
from lightning_pose.losses import LossConfig, PoseLoss
from lightning_pose.metrics.pose_metrics import PoseMetrics

__all__ = ["Pose", "PoseModule"]

Stage = Literal["train", "val", "test"]

_MOST_ELEMENTS = 2**25  # of the features that the scale is learnt from, where frames are large


class Pose(NamedTuple):
    """Camera-to-world poses: `position_m` (..., 3) in metres, `quat_wxyz` (..., 4) unit."""

    position_m: Tensor
    quat_wxyz: Tensor


class PoseModule(LightningModule):
    """Base class of the architectures.

    To add one, subclass it in a file of its own, call `super().__init__(**kwargs)` first, and set

    - `self.network`: features (B, *input_shape) -> (B, 7), three numbers for the position and four for the
      quaternion: with `standardize` in standard deviations around the mean training pose, otherwise in metres
      and quaternion components. The loss always compares metres and quaternion components;
    - `input_ranks`: how many axes `input_shape` may have;
    - `feature_axis`: which axis holds the columns to standardize, if not the last;
    - `memory`: names of what is as long as the training split; a checkpoint's length is taken over.

    Then export it in `models/__init__.py` and give it a config. Constructor arguments are plain types: they are
    the checkpoint's hyperparameters, and rebuild the module anywhere.

    Args:
        input_shape: shape of one frame's features; on the command line it follows from the data.
        loss: settings of `PoseLoss`.
        learning_rate: of Adam with decoupled weight decay, at its highest.
        weight_decay: decoupled weight decay.
        schedule: `constant`, or `cosine` decay to zero over the run, after a warm-up of 5 % of its steps.
        standardize: let the network predict in standard deviations around the mean training pose.
        standardize_features: let the network read each column of the features in standard deviations around its
            mean over the training frames. Descriptors have unit length, so that their elements are small.

    Raises:
        ConfigError: `input_shape` does not suit the architecture, or a rate is out of its range.
    """

    input_ranks: ClassVar[tuple[int, ...]]
    feature_axis: ClassVar[int] = -1
    memory: ClassVar[tuple[str, ...]] = ()
    reads_clips: ClassVar[bool] = False
    network: nn.Module
    pose_mean: Tensor
    pose_scale: Tensor
    quat_reference: Tensor
    feature_mean: Tensor
    feature_scale: Tensor

    def __init__(
        self,
        input_shape: list[int],
        loss: LossConfig | None = None,
        learning_rate: float = 1e-3,
        weight_decay: float = 0.0,
        schedule: Literal["constant", "cosine"] = "cosine",
        standardize: bool = True,
        standardize_features: bool = True,
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
        self.val_metrics = PoseMetrics()
        self.test_metrics = PoseMetrics()
        self.register_buffer("pose_mean", torch.zeros(7))
        self.register_buffer("pose_scale", torch.ones(7))
        self.register_buffer("quat_reference", torch.tensor([1.0, 0.0, 0.0, 0.0]))
        columns = [1] * len(self.input_shape)
        columns[self.feature_axis] = self.input_shape[self.feature_axis]
        self.register_buffer("feature_mean", torch.zeros(columns))
        self.register_buffer("feature_scale", torch.ones(columns))

    @property
    def headline(self) -> str:
        """The settings that distinguish runs of this architecture, for run names and tables."""
        return "x".join(map(str, self.input_shape))

    @property
    def learns_from(self) -> tuple[str, ...]:
        """The splits whose poses end up in the weights; image retrieval may search the same."""
        return ("train",)

    def forward(self, features: Tensor) -> Pose:
        """Features (B, *input_shape) -> poses of B frames."""
        position_m, quat_raw = self._decode(features)
        return Pose(position_m, quat_normalize(quat_raw))

    def _decode(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Positions in metres and quaternions not yet normalised, as the losses of the thesis compare them."""
        return self._unscaled(self.network(self._standardized(features)))

    def _decode_batch(self, batch: PoseBatch) -> tuple[Tensor, Tensor]:
        """As `_decode`, for an architecture that must know which frames it is trained on."""
        return self._decode(batch.features)

    def _standardized(self, features: Tensor) -> Tensor:
        if not self.standardize_features:
            return features
        return (features - self.feature_mean) / self.feature_scale

    def _unscaled(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        pose = pose * self.pose_scale + self.pose_mean
        return pose[..., :3], pose[..., 3:]

    def fit_scale(self, position_m: Tensor, quat_wxyz: Tensor) -> None:
        """Learn the hemisphere of the targets, and with `standardize` their mean and spread, from training poses.

        One spread serves the three axes of the position and one the four components of the quaternion, so that
        distances keep their shape.
        """
        self.quat_reference.copy_(mean_quat(quat_wxyz))
        if self.standardize:
            poses = torch.cat([position_m, align_hemisphere(quat_wxyz, self.quat_reference)], dim=-1)
            self.pose_mean.copy_(poses.mean(0))
            for part in (slice(0, 3), slice(3, 7)):
                variance = (poses[:, part] - self.pose_mean[part]).square().mean()
                self.pose_scale[part] = variance.sqrt().clamp(min=1e-6)

    def fit_feature_scale(self, features: Tensor) -> None:
        """Learn each column's mean and spread from (B, *input_shape) training features.

        Rows of zeros, where a frame had fewer features, do not count. A thousand frames are enough.
        """
        if not self.standardize_features:
            return
        frames = min(1000, max(1, _MOST_ELEMENTS // max(1, features[0].numel())))
        rows = features[:: -(-len(features) // frames)].movedim(self.feature_axis, -1).flatten(0, -2)
        rows = rows[rows.any(1)].float()
        if len(rows) > 1:
            self.feature_mean.copy_(rows.mean(0).view_as(self.feature_mean))
            self.feature_scale.copy_(rows.std(0).clamp(min=1e-6).view_as(self.feature_scale))

    def check_data(self, datamodule: Any) -> None:
        """Refuse data that this architecture cannot read; the command line asks before it opens a run.

        Raises:
            ConfigError: it gives clips where images are read, or the other way round.
        """
        if self.reads_clips != getattr(datamodule, "gives_clips", False):
            wanted, given = ("clips", "images") if self.reads_clips else ("images", "clips")
            raise ConfigError(
                f"{type(self).__name__} reads {wanted}, but {type(datamodule).__name__} gives {given}; set "
                f"data.class_path to lightning_pose.data.{wanted.title()[:-1]}DataModule"
            )

    def setup(self, stage: str) -> None:
        self.check_data(self.trainer.datamodule)  # type: ignore[attr-defined]
        if stage == "fit":
            train = self.trainer.datamodule.dataset("train")  # type: ignore[attr-defined]
            self.fit_scale(*(part.to(self.device) for part in self._training_poses(train)))
            self.fit_feature_scale(train.data.features)

    def _training_poses(self, train: Any) -> tuple[Tensor, Tensor]:
        """Positions (M, 3) and quaternions (M, 4) that the network is to answer with in training."""
        return train.data.position_m, train.data.quat_wxyz

    def _step(self, batch: PoseBatch, stage: Stage) -> tuple[Tensor, Pose]:
        """The one step behind training, validation and test: decode, compare, log."""
        position_m, quat_raw = self._decode_batch(batch)
        target = align_hemisphere(batch.quat_wxyz, self.quat_reference)
        terms = self.loss(position_m, quat_raw, batch.position_m, target)
        names = {f"{stage}/loss" if name == "total" else f"{stage}/loss_{name}": t for name, t in terms.items()}
        self.log_dict(names, on_step=False, on_epoch=True, batch_size=len(batch.frame))
        pose = Pose(position_m, quat_normalize(quat_raw))
        if stage != "train":
            metrics = self.val_metrics if stage == "val" else self.test_metrics
            metrics.update(*self._judged(pose), *self._judged(Pose(batch.position_m, batch.quat_wxyz)))
        return terms["total"], pose

    def _judged(self, pose: Pose) -> Pose:
        """The part of a batch's poses that metrics count."""
        return pose

    def training_step(self, batch: PoseBatch, batch_idx: int) -> Tensor:
        return self._step(batch, "train")[0]

    def validation_step(self, batch: PoseBatch, batch_idx: int) -> None:
        self._step(batch, "val")

    def test_step(self, batch: PoseBatch, batch_idx: int) -> Pose:
        return self._step(batch, "test")[1]

    def predict_step(self, batch: PoseBatch, batch_idx: int) -> Pose:
        return self(batch.features)

    def on_validation_epoch_end(self) -> None:
        self._log_metrics(self.val_metrics, "val")

    def on_test_epoch_end(self) -> None:
        self._log_metrics(self.test_metrics, "test")

    def _log_metrics(self, metrics: PoseMetrics, stage: Stage) -> None:
        self.log_dict({f"{stage}/{name}": value for name, value in metrics.compute().items()})
        metrics.reset()

    def configure_optimizers(self) -> Any:
        # Foreach kernels: one launch for all tensors, which matters for networks as small as these.
        optimizer = torch.optim.AdamW(
            self.parameters(), lr=self.learning_rate, weight_decay=self.weight_decay, foreach=True
        )
        if self.schedule == "constant":
            return optimizer
        steps = int(self.trainer.estimated_stepping_batches)
        warmup = max(1, steps // 20)

        def factor(step: int) -> float:
            if step < warmup:
                return (step + 1) / warmup
            return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(1, steps - warmup)))

        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def describe(self) -> Spec:
        """Plain settings that rebuild this module; checkpoints carry them."""
        return {"class_path": class_path(self), "init_args": dict(self.hparams)}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        saved = checkpoint.get("lightning_pose", {}).get("model", {}).get("class_path", class_path(self))
        saved = resolve_class_path(saved)
        if saved != class_path(self):
            raise CheckpointError(
                f"the checkpoint holds a {saved.rpartition('.')[2]}, not a {type(self).__name__}; "
                "give the config it was trained with"
            )
        self._make_room(checkpoint["state_dict"])
        own = self.state_dict()
        for name, value in checkpoint["state_dict"].items():
            if name in own and own[name].shape != value.shape:
                raise CheckpointError(
                    f"{name} has shape {tuple(value.shape)} in the checkpoint and {tuple(own[name].shape)} here; "
                    "give the settings it was trained with, data.extractor included"
                )

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        self._make_room({name.removeprefix(prefix): value for name, value in state_dict.items()})
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _make_room(self, state_dict: dict[str, Tensor]) -> None:
        """Let the memory be as long as the checkpoint's; other differences in shape are left to be refused."""
        for name in self.memory:
            if name in state_dict:
                tensor = self.get_parameter(name) if name in dict(self.named_parameters()) else self.get_buffer(name)
                tensor.data = tensor.new_zeros(len(state_dict[name]), *tensor.shape[1:])

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        datamodule = getattr(self.trainer, "datamodule", None)
        checkpoint["lightning_pose"] = {
            "model": self.describe(),
            "data": datamodule.describe() if datamodule is not None else None,
        }
