"""ClosedFormModule: what the architectures share that are solved by ridge regression, without gradients."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from functools import partial
from typing import Any, ClassVar, cast

import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor, nn

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.datamodule import scene_datamodule
from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import align_hemisphere
from lightning_pose.models.base import PoseModule
from lightning_pose.models.parts.refined_ridge import solve_ridges
from lightning_pose.models.parts.ridge import Moments, Ridge

__all__ = ["ClosedFormModule", "LinearNetwork"]

_CHUNK = 1024  # frames at a time


class LinearNetwork(nn.Module, ABC):
    """Seven numbers that are linear in what `lift` makes of the features, solved at once by ridge regression.

    Attributes:
        products_in: the precision of products of lifted features. From single precision, which takes half the time,
            weights are corrected in further passes over the frames.
    """

    products_in: ClassVar[torch.dtype] = torch.float32

    @property
    @abstractmethod
    def n_lifted(self) -> int:
        """R: how many columns `lift` returns."""

    @abstractmethod
    def lift(self, features: Tensor) -> Tensor:
        """(B, D) features -> (B, R) columns that the answer is linear in."""

    @abstractmethod
    def set_solution(self, solution: Ridge) -> None:
        """Set the weights to a solution in terms of the lifted features."""

    @abstractmethod
    def forward(self, features: Tensor) -> Tensor:
        """(B, D) -> (B, 7)."""


class ClosedFormModule(PoseModule):
    """Base class of the architectures that one ridge regression solves; `self.network` is a `LinearNetwork`.

    One pass over the training batches sums their moments; memory is of the order of R x R for any number of frames,
    and under several processes the sums are joined. Each lambda is solved for, to double precision, and the one with
    the lowest loss on validation frames is kept.

    Args:
        lambdas: ridge strengths to choose from.
        components: regress on so many principal components of the features (eq. 5.4) instead of all.
        refit: once lambda is chosen, solve again with the validation frames among the training frames. The
            validation metrics stay those of the solution without.
        standardize_features: see `PoseModule`; off, because a CNN's strong features are the informative ones.
        **kwargs: what `PoseModule` takes. `loss` only chooses lambda; `learning_rate`, `weight_decay` and `schedule`
            are ignored.

    Raises:
        ConfigError: no lambda, one that is not above 0, or components not positive; in `fit`, several lambdas without
            validation frames, or more components than the training features have.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (1,)
    network: LinearNetwork

    def __init__(
        self,
        lambdas: list[float],
        components: int | None = None,
        refit: bool = True,
        standardize_features: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(standardize_features=standardize_features, **kwargs)
        if not lambdas or not all(strength > 0 for strength in lambdas):
            raise ConfigError(f"lambdas is {lambdas}; give one or more numbers above 0, such as [8.0]")
        if components is not None and components < 1:
            raise ConfigError(f"components is {components}; give 1 or more, or null for all features")
        self.automatic_optimization = False
        self.lambdas = lambdas
        self.components = components
        self.refit = refit

    @property
    def training_splits(self) -> tuple[str, ...]:
        return ("train", "val") if self.refit else ("train",)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        # It has no gradient to step along, but Lightning writes no checkpoint before some optimizer has stepped.
        return torch.optim.SGD(self.parameters())

    def on_train_epoch_start(self) -> None:
        # Single precision is corrected by reading all frames again, which principal components could not be.
        limit = self.trainer.limit_train_batches  # a share of the batches, or a whole number of them
        corrected = self.components is None and isinstance(limit, float) and limit == 1
        precision = self.network.products_in if corrected else torch.float64
        self.moments = Moments(self.network.n_lifted, 7, precision)

    def training_step(self, batch: PoseBatch, batch_idx: int) -> None:
        self.add_frames(batch, len(scene_datamodule(self.trainer).dataset("train")))
        if self.trainer.is_last_batch:  # before the validation that closes the epoch
            self._solve()
            cast(LightningOptimizer, self.optimizers()).step()

    @torch.no_grad()
    def on_train_epoch_end(self) -> None:
        # Validation is over, and checkpoints are not written yet.
        if self.refit and self._validates:
            for batch in self._batches("val"):
                self.moments.add(*self._regression_terms(batch))
            self.network.set_solution(self._find_solutions([self._lambda], ["train", "val"])[0])
        for batch in self._batches("train"):
            self._train_step(batch)
        self.log("train/lambda", self._lambda)
        del self.moments
        super().on_train_epoch_end()
        self.trainer.should_stop = True  # further epochs would find the same

    def add_frames(self, batch: PoseBatch, frames: int) -> None:
        """Add a training batch to the moments, each frame once.

        Args:
            batch: the next batch of this process.
            frames: how many the whole training split has.
        """
        # A distributed sampler deals frames in turn, and repeats the first until all processes have as many.
        own = -(-(frames - self.trainer.global_rank) // self.trainer.world_size)
        x, y = self._regression_terms(batch)
        new = own - self.moments.count
        self.moments.add(x[:new], y[:new])

    @torch.no_grad()
    def _solve(self) -> None:
        """Set the network to the solution with the best lambda.

        Raises:
            ConfigError: there are several lambdas and no validation frames.
        """
        if self.trainer.world_size > 1:
            self.moments.all_reduce(partial(self.trainer.strategy.reduce, reduce_op="sum"))
        if len(self.lambdas) > 1 and not self._validates:
            raise ConfigError(
                f"lambdas is {self.lambdas}, and there are no validation frames to choose by; "
                "give one, or set data.val_fraction, such as 0.1"
            )
        solutions = self._find_solutions(self.lambdas, ["train"])
        best = min(range(len(solutions)), key=lambda i: self._val_loss(solutions[i])) if self._validates else 0
        self.network.set_solution(solutions[best])
        self._lambda = self.lambdas[best]

    def _find_solutions(self, lambdas: list[float], splits: list[str]) -> list[Ridge]:
        """The solution for each lambda; the moments are of all frames of these splits."""
        if self.components is not None:
            return self.moments.ridge(lambdas, self.components)
        return solve_ridges(self.moments, lambdas, lambda: map(self._regression_terms, self._batches(*splits)))

    @property
    def _validates(self) -> bool:
        """Whether there are validation frames."""
        return sum(self.trainer.num_val_batches) > 0

    def _val_loss(self, solution: Ridge) -> float:
        """Sum of a solution's losses on validation frames, to which the network is set."""
        # The loss, and not the median error: over so few frames that jumps from one lambda to the next.
        self.network.set_solution(solution)
        total = 0.0
        for batch in self._batches("val"):
            target = align_hemisphere(batch.quat_wxyz, self.quat_reference)
            position, quat_raw = self.decode_features(batch.features)
            loss = self.loss(position, quat_raw, batch.position_m.to(position.dtype), target)["total"]
            total += float(loss) * len(batch.frame)
        return total

    def _regression_terms(self, batch: PoseBatch) -> tuple[Tensor, Tensor]:
        """What the poses are regressed on (B, R), and the poses as the network predicts them (B, 7)."""
        poses = torch.cat([batch.position_m, align_hemisphere(batch.quat_wxyz, self.quat_reference)], dim=1)
        features = self.network.lift(self.standardize_input(batch.features))
        return features, (poses - self.pose_mean) / self.pose_scale

    def _batches(self, *splits: str) -> Iterator[PoseBatch]:
        """All frames of splits, localized, in every process."""
        for split in splits:
            data = self.localize_batch(scene_datamodule(self.trainer).dataset(split).data)
            for parts in zip(*(tensor.split(_CHUNK) for tensor in data), strict=True):
                yield PoseBatch(*(part.to(self.device) for part in parts))
