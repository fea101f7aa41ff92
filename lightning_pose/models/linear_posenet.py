"""LinearPoseNet: one ridge regression from a frozen CNN's features, solved in closed form (thesis, chapter 5)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import align_hemisphere
from lightning_pose.models.base import PoseModule
from lightning_pose.models.parts.ridge import Moments, Ridge

__all__ = ["LinearPoseNet"]

_CHUNK = 1024


class LinearPoseNet(PoseModule):
    """Ridge regression (eq. 5.2) from (D,) features to the pose, without gradients.

    One pass over the training batches sums their moments in double precision; memory is of the order of D x D for
    any number of frames, and under several processes the sums are joined. The lambda with the lowest loss on
    validation frames is kept. `loss` serves for nothing else; learning rate, decay and schedule for nothing.

    Args:
        lambdas: ridge strengths to choose from, in squared units of the features, summed over frames.
        components: regress on so many principal components of the features (eq. 5.4) instead of all.
        refit: once lambda is chosen, solve again with the validation frames among the training frames. The
            validation metrics stay those of the solution without.
        standardize_features: see `PoseModule`; off, because a CNN's strong features are its telling ones.
        **kwargs: what `PoseModule` takes.

    Raises:
        ConfigError: no lambda, one that is not above 0, or components not positive; in `fit`, several lambdas without
            validation frames, or more components than the training features have.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (1,)
    network: Any  # _FoldedLinear; a subclass may have another with its `n_features`, `lift` and `take`

    def __init__(
        self,
        lambdas: list[float] = [8.0],  # noqa: B006  (never changed; shown as it is in --help)
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
        self.network = _FoldedLinear(self.input_shape[0], components)

    @property
    def headline(self) -> str:
        return f"D={self.input_shape[0]}" + (f" components={self.components}" if self.components else "")

    @property
    def learns_from(self) -> tuple[str, ...]:
        return ("train", "val") if self.refit else ("train",)

    def configure_optimizers(self) -> Any:
        # It has no gradient to step along, but Lightning writes no checkpoint before some optimizer has stepped.
        return torch.optim.SGD(self.parameters())

    def on_train_epoch_start(self) -> None:
        self._moments = Moments(self.network.n_features, 7)

    def training_step(self, batch: PoseBatch, batch_idx: int) -> None:  # type: ignore[override]
        self._add(batch, len(self.trainer.datamodule.dataset("train")))  # type: ignore[attr-defined]
        if self.trainer.is_last_batch:  # before the validation that closes the epoch
            self._solve()
            self.optimizers().step()  # type: ignore[union-attr]

    @torch.no_grad()
    def on_train_epoch_end(self) -> None:
        # Validation is over, and checkpoints are not written yet.
        if self.refit and self._validates:
            for batch in self._batches("val"):
                self._moments.add(*self._scaled(batch))
            self.network.take(self._moments.ridge([self._lambda], self.components)[0])
        for batch in self._batches("train"):
            self._step(batch, "train")
        self.log("train/lambda", self._lambda)
        del self._moments
        self.trainer.should_stop = True  # further epochs would find the same

    def _add(self, batch: PoseBatch, frames: int) -> None:
        # A distributed sampler deals frames in turn, and repeats the first until all processes have as many.
        own = -(-(frames - self.trainer.global_rank) // self.trainer.world_size)
        x, y = self._scaled(batch)
        new = own - self._moments.count
        self._moments.add(x[:new], y[:new])

    @torch.no_grad()
    def _solve(self) -> None:
        if self.trainer.world_size > 1:
            self._moments.all_reduce(partial(self.trainer.strategy.reduce, reduce_op="sum"))
        if len(self.lambdas) > 1 and not self._validates:
            raise ConfigError(
                f"lambdas is {self.lambdas}, and there are no validation frames to choose by; "
                "give one, or set data.val_fraction, such as 0.1"
            )
        solutions = self._moments.ridge(self.lambdas, self.components)
        best = min(range(len(solutions)), key=lambda i: self._val_loss(solutions[i])) if self._validates else 0
        self.network.take(solutions[best])
        self._lambda = self.lambdas[best]

    @property
    def _validates(self) -> bool:
        return sum(self.trainer.num_val_batches) > 0

    def _val_loss(self, solution: Ridge) -> float:
        # The mean loss, and not the median error: over so few frames that jumps from one lambda to the next.
        self.network.take(solution)
        total = 0.0
        for batch in self._batches("val"):
            target = align_hemisphere(batch.quat_wxyz, self.quat_reference)
            loss = self.loss(*self._decode(batch.features), batch.position_m, target)["total"]
            total += float(loss) * len(batch.frame)
        return total

    def _scaled(self, batch: PoseBatch) -> tuple[Tensor, Tensor]:
        """What the poses are regressed on, and the poses as the network writes them."""
        poses = torch.cat([batch.position_m, align_hemisphere(batch.quat_wxyz, self.quat_reference)], dim=1)
        features = self.network.lift(self._standardized(batch.features))
        return features, (poses - self.pose_mean) / self.pose_scale

    def _batches(self, split: str) -> Iterator[PoseBatch]:
        """All frames of a split, in every process."""
        data = self.trainer.datamodule.dataset(split).data  # type: ignore[attr-defined]
        for parts in zip(*(tensor.split(_CHUNK) for tensor in data), strict=True):
            yield PoseBatch(*(part.to(self.device) for part in parts))


class _FoldedLinear(nn.Module):
    """Seven numbers, linear in the features.

    With principal components, what is learnt are 7 x K coefficients, and what is applied is their product with the
    components, 7 x D: the K x D components would make a file of megabytes, and say no more.
    """

    bias: Tensor
    folded: Tensor | None

    def __init__(self, n_features: int, components: int | None) -> None:
        super().__init__()
        self.n_features = n_features
        self.weight = nn.Parameter(torch.zeros(7, components or n_features))
        self.register_buffer("bias", torch.zeros(7))
        self.register_buffer("folded", torch.zeros(7, n_features) if components else None)

    def lift(self, features: Tensor) -> Tensor:
        """What the solution is linear in: the features."""
        return features

    def take(self, solution: Ridge) -> None:
        """Become this solution."""
        self.weight.copy_(solution.coefficients)
        self.bias.copy_(solution.bias)
        if self.folded is not None:
            self.folded.copy_(solution.weight)

    def forward(self, features: Tensor) -> Tensor:
        """(B, D) -> (B, 7)."""
        return F.linear(features, self.weight if self.folded is None else self.folded, self.bias)
