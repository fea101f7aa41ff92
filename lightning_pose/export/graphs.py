"""A trained system's network as a torch module that ONNX can hold: fixed shapes, no branches on data.

`make_graph` returns a module from one image's features, or for CNN features from its pixels, to pose and radii.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lightning_pose.errors import ConfigError
from lightning_pose.export.recurrent import RecurrentClips
from lightning_pose.features import CNN, FeatureExtractor
from lightning_pose.geometry.quaternions import quat_normalize
from lightning_pose.models import CNNRNN, GraphPose, NodePose, PoseModule, SurfCNN
from lightning_pose.models.clip import ClipModule
from lightning_pose.models.parts.error_radius import CELLS, ErrorRadius
from lightning_pose.models.parts.graph_conv import GraphConvolution
from lightning_pose.models.parts.motion import measure_motion

__all__ = ["OUTPUTS", "ClipGraph", "PoseGraph", "make_graph"]

OUTPUTS = ("position_m", "quat_wxyz", "radius_m", "radius_deg", "excess")
"""Names of what a graph of single images returns; a graph of clips returns the first two."""

Decode = Callable[[Tensor], tuple[Tensor, Tensor]]


def make_graph(model: PoseModule, extractor: FeatureExtractor) -> nn.Module:
    """The module from features (1, *shape), or clips (1, T, *shape), to poses in the world.

    With CNN features it begins with the CNN: it takes (1, 3, side, side) RGB in 0..1.

    Raises:
        ConfigError: this architecture cannot be exported, with the reason.
    """
    if isinstance(model, ClipModule):
        if isinstance(extractor, CNN):
            raise ConfigError(f"{type(model).__name__} of CNN maps cannot be exported; train it on local features")
        return ClipGraph(model)
    return PoseGraph(model, _CNNFeatures(extractor) if isinstance(extractor, CNN) else nn.Identity())


class PoseGraph(nn.Module):
    """One image to `OUTPUTS`: position (1, 3) float64, quaternion (1, 4); radii and excess (1,) float64 (nan: unknown).

    Args:
        model: any architecture of single images.
        features: what comes before it.
    """

    def __init__(self, model: PoseModule, features: nn.Module) -> None:
        super().__init__()
        self.features = features
        self.model = model
        self.decode = _find_decoder(model)
        self.radius = _Radius(model.radius) if model.radius is not None and len(model.radius.reference) else None
        self.register_buffer("origin", model.world_frame.origin.clone())
        self.scale = model.world_frame.scale

    origin: Tensor

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        features = self.features(image)
        position, quat_raw = self.decode(features)
        unknown = self.origin[:1] + torch.nan
        certainty = (unknown,) * 3 if self.radius is None else self.radius(features)
        return position.double() * self.scale + self.origin, quat_normalize(quat_raw), *certainty


class ClipGraph(nn.Module):
    """One clip (1, T, *shape) to positions (T, 3) float64 and quaternions (T, 4).

    They are those that the network predicts: relative to the frame before where the model integrates, which the runner
    then does, and else to the first frame.

    Args:
        model: of clips.
    """

    def __init__(self, model: ClipModule) -> None:
        super().__init__()
        self.model = model
        self.recurrent = RecurrentClips(model.network) if isinstance(model, CNNRNN) else None
        self.scale = model.world_frame.scale

    def forward(self, clip: Tensor) -> tuple[Tensor, Tensor]:
        model = self.model
        if model.motion:
            read = (measure_motion(clip) / model.motion_scale).transpose(2, 3)
        else:
            read = model.standardize_input(clip)
        images = read.reshape(1, -1, *model.image_shape)
        network = model.network if self.recurrent is None else self.recurrent
        position, quat_raw = model.unscale_pose(network(images))
        return position[0].double() * self.scale, quat_normalize(quat_raw[0])


class _CNNFeatures(nn.Module):
    """A `CNN` extractor behind its preparation of the image: (1, 3, side, side) in 0..1 to (1, *feature_shape)."""

    def __init__(self, extractor: CNN) -> None:
        super().__init__()
        self.cnn = extractor.load_network()
        self.is_map = extractor.output == "map"

    def forward(self, rgb: Tensor) -> Tensor:
        run = getattr(self.cnn, "feature_map", self.cnn) if self.is_map else self.cnn
        out = run(rgb)
        if self.is_map:
            return out.half().float()  # as they are stored
        return out.mean((2, 3)) if out.ndim == 4 else out


class _Radius(nn.Module):
    """The radii and the excess of `ErrorRadius`, with products instead of pools and distances that ONNX lacks."""

    def __init__(self, radius: ErrorRadius) -> None:
        super().__init__()
        for name in ("signs", "mean", "reference", "floor"):
            self.register_buffer(name, getattr(radius, name).float())
        self.register_buffer("lift", radius.lift)
        self.factors = [factor or float("nan") for factor in radius.factors.tolist()]
        self.farthest = (radius.limit or float("nan")) * (float(radius.farthest) or float("nan"))
        self.pools: tuple[Tensor, Tensor] | None = None
        if len(radius.input_shape) == 3 and radius.input_shape[0] <= 4:
            _, height, width = radius.input_shape
            self.pools = _make_pool(height), _make_pool(width).T

    signs: Tensor
    mean: Tensor
    reference: Tensor
    floor: Tensor
    lift: Tensor | None

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        features = features.float()
        if features.ndim == 3:
            features = features.sum(1) if self.lift is None else (features @ self.lift).relu().sum(1)
        elif features.ndim == 4:
            features = features.mean((2, 3)) if self.pools is None else self.pools[0] @ features @ self.pools[1]
        keys = (F.normalize(features.flatten(1), dim=1) - self.mean) @ self.signs
        distance = (keys - self.reference).square().sum(1, keepdim=True).sqrt().amin(0)
        scale = (distance + self.floor).double()
        return scale * self.factors[0], scale * self.factors[1], distance.double() / self.farthest


def _make_pool(size: int) -> Tensor:
    """(CELLS, size): adaptive average pooling of an axis, as a product."""
    pool = torch.zeros(CELLS, size)
    for cell in range(CELLS):
        first, last = cell * size // CELLS, -(-(cell + 1) * size // CELLS)
        pool[cell, first:last] = 1 / (last - first)
    return pool


def _find_decoder(model: PoseModule) -> Decode:
    """Features (1, *shape) to local position (1, 3) and quaternion (1, 4), without branches on data."""
    if isinstance(model, NodePose):
        return _NodeDecoder(model)
    if isinstance(model, GraphPose):
        return _CellDecoder(model)
    if isinstance(model, SurfCNN) and not model.network.ordered:
        return _UnorderedDecoder(model)
    return model.decode_features


class _UnorderedDecoder(nn.Module):
    """SurfCNN without an order: the mean over real rows, by their weights in every case."""

    def __init__(self, model: SurfCNN) -> None:
        super().__init__()
        self.model = model
        self.convolutions, self.head = (model.network.get_submodule(name) for name in ("convolutions", "head"))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        read = self.model.standardize_input(features)
        maps = self.convolutions(read.unsqueeze(1))
        real = (read != 0).any(-1).to(maps.dtype)
        weight = torch.where(real.sum(1, keepdim=True) > 0, real, torch.ones_like(real))[:, None, :, None]
        return self.model.unscale_pose(self.head((maps * weight).sum(2) / weight.sum(2)))


class _NodeDecoder(nn.Module):
    """NodePose with its training images' states as constants, and a fixed number of edges to the one image."""

    def __init__(self, model: NodePose) -> None:
        super().__init__()
        memory = model.compute_memory()
        self.model = model
        keys = F.normalize(model.memory_features, dim=-1) if model.normalize else model.memory_features
        self.k = min(model.neighbours, len(keys))
        self.register_buffer("keys", keys.clone())
        self.register_buffer("offset", memory.offset.clone())
        for i, states in enumerate(memory.states):
            self.register_buffer(f"states_{i}", states.clone())

    keys: Tensor
    offset: Tensor

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        model = self.model
        key = F.normalize(features, dim=-1) if model.normalize else features
        squared = self.keys.square().sum(1) - 2 * (self.keys @ key[0])
        nearest = squared.topk(self.k, largest=False).indices
        target = model.standardize_input(features)
        for i, convolution in enumerate(model.network.convolutions):
            source = getattr(self, f"states_{i}")[nearest]
            edges = torch.stack([torch.arange(self.k), torch.zeros(self.k, dtype=torch.int64)])
            target = _convolve(convolution, target, source, edges, self.k).relu()
        pose = model.network.heads(target)
        if model.neighbour_poses:
            pose = model.slope * pose + self.offset[nearest[: model.neighbour_poses]].mean(0, keepdim=True)
        return model.unscale_pose(pose)


class _CellDecoder(nn.Module):
    """GraphPose with as many edges for every image."""

    def __init__(self, model: GraphPose) -> None:
        super().__init__()
        self.model = model
        self.convolutions = list(model.network.get_submodule("convolutions").children())
        self.heads = model.network.get_submodule("heads")

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        maps, network = self.model.standardize_input(features), self.model.network
        _, _, h, w = maps.shape
        count, k = h * w, min(self.model.neighbours, h * w - 1)
        nodes = maps.flatten(2).transpose(1, 2)[0]
        squares = nodes.square().sum(1)
        squared = squares[:, None] + squares - 2 * nodes @ nodes.T + torch.diag(torch.full((count,), torch.inf))
        nearest = squared.topk(k, largest=False).indices
        edges = torch.stack([nearest.flatten(), torch.arange(count).repeat_interleave(k)])
        if network.places:
            grid = torch.cartesian_prod(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w))
            nodes = torch.cat([nodes, grid.to(nodes.dtype)], dim=1)
        for convolution in self.convolutions:
            nodes = _convolve(convolution, nodes, nodes, edges, k).relu()
        return self.model.unscale_pose(
            self.heads((nodes.mean(0) if network.readout == "mean" else nodes.amax(0))[None])
        )


def _convolve(convolution: nn.Module, target: Tensor, source: Tensor, edges: Tensor, k: int) -> Tensor:
    """As `GraphConvolution.forward`, where each target has k neighbours, so that no node counts them."""
    assert isinstance(convolution, GraphConvolution)
    if not convolution.is_gcn:
        return convolution(target, source, edges)
    count = len(target)
    nodes, first = (target, 0) if source is target else (torch.cat([target, source]), count)
    itself = torch.arange(count)
    edges = torch.stack([torch.cat([edges[0] + first, itself]), torch.cat([edges[1], itself])])
    return convolution.layer(nodes, edges, torch.full((edges.shape[1],), 1 / (k + 1)))[:count]
