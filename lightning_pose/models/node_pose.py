"""NodePose: each image is a node, joined to the training images most like it (thesis, chapter 4)."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.graph import edge_index, neighbourhood, sample_neighbours, search_neighbours
from lightning_pose.errors import ConfigError
from lightning_pose.geometry import align_hemisphere
from lightning_pose.models.base import PoseModule
from lightning_pose.models.graph_conv import GraphConvolution, PoseHeads

__all__ = ["NodePose"]

_MEMORY = ("memory_features", "memory_pose", "memory_frame", "memory_table")
_CHUNK = 1024  # nodes whose neighbours' states are gathered at a time


class NodePose(PoseModule):
    """Graph convolutions over images: a node hears the K training images nearest in feature space.

    Edges lead from training images alone, and to a query as to a training image. So queries never hear each other,
    and the training images' states, computed once, serve them all. The training images' features are part of the
    checkpoint.

    The thesis's form is the one of the default arguments: nodes carry features only. With `neighbour_poses` they
    know where they are: the last convolution also hears the neighbours' poses, and the answer is a correction of
    their mean. A node's own pose enters nowhere on the way to its own answer.

    Args:
        neighbours: K.
        conv: `wl`, `gcn`, or the name of another convolution of PyG, as for `GraphConvolution`.
        aggr: how a node brings its neighbours together: `add`, `mean`, `max`; the convolution's own way if not given.
        channels: width of each convolution.
        dropout: before each convolution.
        normalize: search neighbours by L2 between features of unit length, as image retrieval does.
        neighbour_poses: let nodes know their neighbours' poses.
        gap: training images are joined only if at least this many frames lie between their places in the scene. 1 is
            the thesis's. Neighbours in a video are closer than those of a new image will ever be, and a network
            that learns from these relies on them too much.
        full_graph_limit: up to this many training images every step computes the whole graph; with more, the part
            that the batch depends on, with `fanout` neighbours of each node drawn at random.
        fanout: see above.
        **kwargs: what `PoseModule` takes.

    Raises:
        ConfigError: a number is out of its range, or a convolution cannot be built.
    """

    input_rank: ClassVar[int] = 1
    memory_features: Tensor
    memory_pose: Tensor
    memory_frame: Tensor
    memory_table: Tensor

    def __init__(
        self,
        neighbours: int = 5,
        conv: str = "wl",
        aggr: str | None = None,
        channels: list[int] = [256, 128, 64],  # noqa: B006  (never changed; shown as it is in --help)
        dropout: float = 0.0,
        normalize: bool = True,
        neighbour_poses: bool = False,
        gap: int = 1,
        full_graph_limit: int = 10_000,
        fanout: int = 10,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        for name, value in (("neighbours", neighbours), ("gap", gap), ("fanout", fanout)):
            if value < 1:
                raise ConfigError(f"{name} is {value}; give 1 or more")
        if not channels or not 0 <= dropout < 1:
            raise ConfigError(f"channels are {channels} and dropout is {dropout}; give widths, and 0 to below 1")
        self.neighbours = neighbours
        self.normalize = normalize
        self.gap = gap
        self.full_graph_limit = full_graph_limit
        self.fanout = fanout
        self.network = _NodeNetwork(self.input_shape[0], conv, aggr, channels, dropout, neighbour_poses)
        # Their length is the training split's; `_make_room` gives them a checkpoint's.
        self.register_buffer("memory_features", torch.zeros(0, *self.input_shape))
        self.register_buffer("memory_pose", torch.zeros(0, 7))
        self.register_buffer("memory_frame", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("memory_table", torch.zeros(0, neighbours, dtype=torch.int64))
        self._states: tuple[Tensor, list[Tensor]] | None = None

    @property
    def headline(self) -> str:
        return f"K={self.neighbours}"

    def setup(self, stage: str) -> None:
        super().setup(stage)
        if stage == "fit":
            self.remember(self.trainer.datamodule.dataset("train").data)  # type: ignore[attr-defined]

    def remember(self, train: PoseBatch) -> None:
        """Take in the training images that nodes hear, once the scale of poses is known, and join them."""
        train = PoseBatch(*(tensor[train.frame.argsort()].to(self.device) for tensor in train))
        pose = torch.cat([train.position_m, align_hemisphere(train.quat_wxyz, self.quat_reference)], dim=-1)
        self.memory_features = train.features
        self.memory_pose = (pose - self.pose_mean) / self.pose_scale
        self.memory_frame = train.frame
        keys = self._key(train.features)
        self.memory_table = search_neighbours(keys, keys, self.neighbours, train.frame, train.frame, self.gap)
        self._states = None

    def _decode(self, features: Tensor) -> tuple[Tensor, Tensor]:
        keys, states = self._remembered()
        table = search_neighbours(self._key(features), keys, self.neighbours)
        target = self._standardized(features)
        for layer, source in enumerate(states[:-1]):
            target = self.network.hidden(layer, target, source, table)
        return self._unscaled(self.network.answer(target, states[-1], table, self.memory_pose))

    def _decode_batch(self, batch: PoseBatch) -> tuple[Tensor, Tensor]:
        if not self.training:
            return self._decode(batch.features)
        self._states = None  # weights are about to change
        rows, table = torch.searchsorted(self.memory_frame, batch.frame), self.memory_table
        features, pose = self.memory_features, self.memory_pose
        if len(table) > self.full_graph_limit:
            table = sample_neighbours(table, self.fanout)
            nodes, table, rows = neighbourhood(table, rows, hops=len(self.network.convolutions))
            features, pose = features[nodes], pose[nodes]
        state = self.network.states(self._standardized(features), table)[-1]
        return self._unscaled(self.network.answer(state[rows], state, table[rows], pose))

    def _remembered(self) -> tuple[Tensor, list[Tensor]]:
        """What queries are compared with, and what they hear at each convolution; computed when first needed."""
        if self._states is None or self._states[0].device != self.device:
            with torch.inference_mode(False), torch.no_grad():
                features = self.memory_features
                states = self.network.states(self._standardized(features), self.memory_table)
                self._states = self._key(features), states
        return self._states

    def _key(self, features: Tensor) -> Tensor:
        return F.normalize(features, dim=-1) if self.normalize else features

    def train(self, mode: bool = True) -> NodePose:
        self._states = None
        return super().train(mode)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self._make_room(checkpoint["state_dict"])
        super().on_load_checkpoint(checkpoint)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        self._make_room({name.removeprefix(prefix): value for name, value in state_dict.items()})
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _make_room(self, state_dict: dict[str, Tensor]) -> None:
        """Let the memory be as long as the checkpoint's; other differences in shape are left to be refused."""
        self._states = None
        for name in _MEMORY:
            if name in state_dict:
                buffer = getattr(self, name)
                setattr(self, name, buffer.new_zeros(len(state_dict[name]), *buffer.shape[1:]))


class _NodeNetwork(nn.Module):
    def __init__(
        self, width: int, conv: str, aggr: str | None, channels: list[int], dropout: float, neighbour_poses: bool
    ) -> None:
        super().__init__()
        self.neighbour_poses = neighbour_poses
        widths = [width, *channels]
        widths_in = widths[:-1]
        widths_in[-1] += 8 if neighbour_poses else 0  # a pose, and a flag that says that there is one
        self.convolutions = nn.ModuleList(
            GraphConvolution(conv, before, after, aggr) for before, after in zip(widths_in, channels, strict=True)
        )
        self.dropout = nn.Dropout(dropout)
        self.heads = PoseHeads(channels[-1])

    def states(self, features: Tensor, table: Tensor) -> list[Tensor]:
        """What each convolution reads of N nodes, (N, D) features first, for their graph (N, K)."""
        states = [features]
        for layer in range(len(self.convolutions) - 1):
            parts = zip(states[-1].split(_CHUNK), table.split(_CHUNK), strict=True)
            states.append(torch.cat([self.hidden(layer, target, states[-1], rows) for target, rows in parts]))
        return states

    def hidden(self, layer: int, target: Tensor, source: Tensor, table: Tensor) -> Tensor:
        """(B, C) states of targets after a convolution over the (M, C) sources that `table` (B, K) joins them to."""
        source_row, target_row = edge_index(table)
        heard, source_row = source_row.unique(return_inverse=True)
        target, source = self.dropout(target), self.dropout(source[heard])
        return self.convolutions[layer](target, source, torch.stack([source_row, target_row])).relu()

    def answer(self, target: Tensor, source: Tensor, table: Tensor, pose: Tensor) -> Tensor:
        """The last convolution and the heads: (B, 7) scaled poses; `pose` (M, 7) is where the sources are."""
        last = len(self.convolutions) - 1
        if not self.neighbour_poses:
            return self.heads(self.hidden(last, target, source, table))
        target = torch.cat([target, target.new_zeros(len(target), 8)], dim=1)
        source = torch.cat([source, pose, pose.new_ones(len(pose), 1)], dim=1)
        return self.heads(self.hidden(last, target, source, table)) + _mean_of_neighbours(pose, table)


def _mean_of_neighbours(pose: Tensor, table: Tensor) -> Tensor:
    """(B, 7) mean of the (M, 7) poses that `table` (B, K) joins each row to; zero, the mean of all, where none."""
    source, target = edge_index(table)
    count = target.bincount(minlength=len(table)).clamp(min=1).unsqueeze(1)
    return pose.new_zeros(len(table), 7).index_add(0, target, pose[source]) / count
