"""NodePose: each image is a node, joined to the training images with the nearest features (thesis, chapter 4)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lightning_pose.data.batches import PoseBatch
from lightning_pose.data.datamodule import scene_datamodule
from lightning_pose.errors import ConfigError
from lightning_pose.geometry.quaternions import align_hemisphere
from lightning_pose.models.base import PoseModule
from lightning_pose.models.parts.graph_conv import GraphConvolution, PoseHeads
from lightning_pose.models.parts.memory import TrainingMemory
from lightning_pose.models.parts.neighbour_graph import list_edges, sample_neighbours
from lightning_pose.models.parts.neighbour_index import NeighbourIndex

__all__ = ["NodePose"]

_CHUNK = 1024  # nodes whose neighbours' states are gathered at a time


class NodePose(TrainingMemory, PoseModule):
    """Graph convolutions over images: each node has edges from the K nearest training images in feature space.

    All edges start at training images; they end at queries and at training images. So queries never affect each other,
    and the training images' states are computed once for all queries. The training images' features are part of the
    checkpoint.

    The thesis's form has `neighbour_poses: 0`: a node receives only its neighbours' features. But their poses are
    known, and a new image is nearer to its neighbours than any regression of its pose. So here the network's errors
    on the nearest neighbours correct its answer, as in Correct and Smooth (Huang et al., ICLR 2021). The answer is

        mean over the neighbours j of (pose_j + slope * (network(query) - network(j))).

    A slope of 0 is image retrieval; a slope of 1 is the network less its neighbours' errors. It is trained as the
    thesis's is, so that no node receives its own pose.

    Args:
        neighbours: K.
        conv: `wl`, `gcn`, or the name of another convolution of PyG, as for `GraphConvolution`.
        aggr: how a node joins its neighbours' messages: `add`, `mean`, `max`; the convolution's own way if not given.
        channels: width of each convolution.
        dropout: before each convolution.
        normalize: search neighbours by L2 between features of unit length, as image retrieval does.
        neighbour_poses: how many of the nearest neighbours correct the answer by their own poses; 0 for none.
        slope: see above.
        gap: training images are joined only if their places in the scene are at least this many frames apart; 1
            joins all, as the thesis does.
        full_graph_limit: up to this many training images every step computes the whole graph. With more, it computes
            the batch alone, which receives what its neighbours' states were when they were last computed, in this epoch
            or at its start (Fey et al., GNNAutoScale, ICML 2021). So an epoch's time is in proportion to the images.
        fanout: in such steps, draw so many neighbours of each node at random, where their mean stands for that of all:
            with `aggr: mean` of `wl` and SAGEConv. The sum or the maximum of a few is not that of all, which
            validation and use compute; so other convolutions read every neighbour.
        **kwargs: what `PoseModule` takes.

    Raises:
        ConfigError: a number is out of its range, or a convolution cannot be built.
    """

    input_ranks: ClassVar[tuple[int, ...]] = (1,)
    memory: ClassVar[tuple[str, ...]] = ("memory_features", "memory_pose", "memory_frame", "memory_table")
    network: _NodeNetwork
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
        neighbour_poses: int = 1,
        slope: float = 0.5,
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
        if not 0 <= neighbour_poses <= neighbours:
            raise ConfigError(
                f"neighbour_poses is {neighbour_poses} and neighbours is {neighbours}; give 0 to as many as neighbours"
            )
        self.neighbours = neighbours
        self.neighbour_poses = neighbour_poses
        self.slope = slope
        self.normalize = normalize
        self.gap = gap
        self.full_graph_limit = full_graph_limit
        self.fanout = fanout
        self.network = _NodeNetwork([self.input_shape[0], *channels], conv, aggr, dropout)
        self.register_buffer("memory_features", torch.zeros(0, *self.input_shape))
        self.register_buffer("memory_pose", torch.zeros(0, 7))
        self.register_buffer("memory_frame", torch.zeros(0, dtype=torch.int64))
        self.register_buffer("memory_table", torch.zeros(0, neighbours, dtype=torch.int64))
        self.register_load_state_dict_post_hook(_forget_states)
        self._memory: _Memory | None = None
        self._index: NeighbourIndex | None = None
        self._history: list[Tensor] | None = None

    @property
    def headline(self) -> str:
        return f"D={self.input_shape[0]} neighbours={self.neighbours}"

    def setup(self, stage: str) -> None:
        super().setup(stage)
        if stage == "fit":
            self.store_training(self.localize_batch(scene_datamodule(self.trainer).dataset("train").data))

    def store_training(self, train: PoseBatch) -> None:
        """Store localized training images, once the scale of poses is known, and join them by edges."""
        order = train.frame.argsort()
        train = train._replace(position_m=train.position_m.to(self.pose_mean.dtype))
        train = PoseBatch(*(tensor[order].to(self.device) for tensor in train))
        pose = torch.cat([train.position_m, align_hemisphere(train.quat_wxyz, self.quat_reference)], dim=-1)
        self.memory_features = train.features
        self.memory_pose = (pose - self.pose_mean) / self.pose_scale
        self.memory_frame = train.frame
        self.forget_features()
        index = self._find_index()
        self.memory_table = index.search(index.reference, self.neighbours, train.frame, train.frame, self.gap)

    def decode_features(self, features: Tensor) -> tuple[Tensor, Tensor]:
        memory = self.compute_memory()
        table = self._find_index().search(self._to_keys(features), self.neighbours)
        pose = self.network(self.standardize_input(features), memory.states, table)
        if self.neighbour_poses:
            pose = self.slope * pose + _average_neighbours(memory.offset, table[:, : self.neighbour_poses])
        return self.unscale_pose(pose)

    def decode_batch(self, batch: PoseBatch) -> tuple[Tensor, Tensor]:
        if not self.training:
            return self.decode_features(batch.features)
        self.forget_states()  # weights are about to change
        rows, table = torch.searchsorted(self.memory_frame, batch.frame), self.memory_table
        if len(table) > self.full_graph_limit:
            answer = self._convolve_batch(rows, table[rows])
        else:
            *_, last = self.network.compute_states(self.standardize_input(self.memory_features), table)
            answer = self.network.convolve(len(self.network.convolutions) - 1, last[rows], last, table[rows])
        return self.unscale_pose(self.network.heads(answer))

    def _convolve_batch(self, rows: Tensor, table: Tensor) -> Tensor:
        """(B, C) last states of training images, from those that their neighbours (B, K) were left in."""
        if self.network.takes_means:
            table = sample_neighbours(table, self.fanout)
        if self._history is None:
            self.network.eval()  # without dropout
            with torch.no_grad():
                self._history = self.network.compute_states(
                    self.standardize_input(self.memory_features), self.memory_table
                )
            self.network.train()
        target = self._history[0][rows]
        for layer, source in enumerate(self._history):
            target = self.network.convolve(layer, target, source, table)
            if layer + 1 < len(self._history):
                self._history[layer + 1][rows] = target.detach()
        return target

    def on_train_epoch_start(self) -> None:
        super().on_train_epoch_start()
        self._history = None

    def forget_features(self) -> None:
        """Drop all that was computed from the training images; it is computed again when next needed."""
        self._index = self._history = None
        self.forget_states()

    def forget_states(self) -> None:
        """Drop the training images' states; they are computed again when next needed."""
        self._memory = None

    def compute_memory(self) -> _Memory:
        """What queries receive, computed when first needed."""
        if self._memory is None or self._memory.offset.device != self.device:
            with torch.inference_mode(False), torch.no_grad():
                states = self.network.compute_states(self.standardize_input(self.memory_features), self.memory_table)
                answer = self.network.heads(self.network.convolve_all(len(states) - 1, states[-1], self.memory_table))
                offset = self.memory_pose - self.slope * answer
                self._memory = _Memory(states, offset)
        return self._memory

    def _find_index(self) -> NeighbourIndex:
        """What queries are compared with, made when first needed."""
        if self._index is None or self._index.reference.device != self.device:
            with torch.inference_mode(False), torch.no_grad():
                self._index = NeighbourIndex(self._to_keys(self.memory_features))
        return self._index

    def _to_keys(self, features: Tensor) -> Tensor:
        """What distances are measured between, (B, D)."""
        return F.normalize(features, dim=-1) if self.normalize else features

    def train(self, mode: bool = True) -> NodePose:
        self.forget_states()
        return super().train(mode)


def _forget_states(module: nn.Module, _: object) -> None:
    """`load_state_dict` calls this once the weights have changed."""
    assert isinstance(module, NodePose)
    module.forget_features()


class _Memory(NamedTuple):
    """What queries need of N training images.

    Attributes:
        states: (N, C) that each convolution receives.
        offset: (N, 7), the scaled pose less the slope's part of the network's answer.
    """

    states: list[Tensor]
    offset: Tensor


class _NodeNetwork(nn.Module):
    """Graph convolutions, and the heads that make a pose of a node's last state."""

    def __init__(self, widths: list[int], conv: str, aggr: str | None, dropout: float) -> None:
        super().__init__()
        self.convolutions = nn.ModuleList(GraphConvolution(conv, *pair, aggr) for pair in pairwise(widths))
        self.dropout = nn.Dropout(dropout)
        self.heads = PoseHeads(widths[-1])

    @property
    def takes_means(self) -> bool:
        """Whether each convolution reads nothing of a node's neighbours but their mean."""
        return all(isinstance(layer, GraphConvolution) and layer.takes_mean for layer in self.convolutions)

    def forward(self, features: Tensor, states: list[Tensor], table: Tensor) -> Tensor:
        """Numbers of targets whose neighbours' states are known.

        Args:
            features: (B, D) of the targets.
            states: (M, C) that each convolution reads of the sources, as `compute_states` returns them.
            table: (B, K) rows of the sources that are each target's neighbours.

        Returns:
            (B, 7).
        """
        target = features
        for layer, source in enumerate(states):
            target = self.convolve(layer, target, source, table)
        return self.heads(target)

    def compute_states(self, features: Tensor, table: Tensor) -> list[Tensor]:
        """What each convolution reads of N nodes, their (N, D) features first, for their graph (N, K)."""
        states = [features]
        for layer in range(len(self.convolutions) - 1):
            states.append(self.convolve_all(layer, states[-1], table))
        return states

    def convolve_all(self, layer: int, state: Tensor, table: Tensor) -> Tensor:
        """One convolution over all N nodes of a graph, some at a time."""
        parts = zip(state.split(_CHUNK), table.split(_CHUNK), strict=True)
        return torch.cat([self.convolve(layer, target, state, rows) for target, rows in parts])

    def convolve(self, layer: int, target: Tensor, source: Tensor, table: Tensor) -> Tensor:
        """(B, C) states of targets after a convolution over the (M, C) sources that `table` (B, K) joins them to."""
        source_row, target_row = list_edges(table)
        used, source_row = source_row.unique(return_inverse=True)
        target, source = self.dropout(target), self.dropout(source[used])
        return self.convolutions[layer](target, source, torch.stack([source_row, target_row])).relu()


def _average_neighbours(rows: Tensor, table: Tensor) -> Tensor:
    """(B, 7) mean of the rows of (M, 7) that `table` (B, K) joins each target to; zero where there are none."""
    source, target = list_edges(table)
    count = target.bincount(minlength=len(table)).clamp(min=1).unsqueeze(1)
    return rows.new_zeros(len(table), 7).index_add(0, target, rows[source]) / count
