"""A problem that any architecture can learn: features that are a fixed linear image of the pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn
from torch.utils.data import DataLoader

from lightning_pose import models
from lightning_pose.data import ClipDataModule, SceneDataModule
from lightning_pose.data.batches import PoseBatch, PoseDataset, make_loader
from lightning_pose.data.clip_dataset import ClipDataset, ClipShape
from lightning_pose.features import SURF, FeatureExtractor
from lightning_pose.geometry.camera import Camera
from lightning_pose.mapping.frames import MapFrames
from lightning_pose.models import PoseModule
from lightning_pose.scenes.scene import Frame, Scene
from tests.helpers import Thumbnails
from tests.mapping.helpers import FOCAL_PX, make_frames, make_walk

__all__ = [
    "ARCHITECTURES",
    "CLIP_LENGTH",
    "WALL_CAMERA",
    "ClipProblem",
    "LearnableProblem",
    "RefinableProblem",
    "SmallCNN",
    "WallProblem",
    "features_for",
    "make_model",
    "problem_class_for",
    "problem_for",
    "random_poses",
]

_INPUT_SHAPES = {1: [32], 2: [20, 64], 3: [16, 3, 4]}

CLIP_LENGTH = 4

WALL_KEYPOINTS = 250
WALL_CAMERA = "PINHOLE,640,480,500,500,319.5,239.5"

_SEEDS = {"train": 0, "val": 11, "test": 12}  # of the frames of each split

_exported = [getattr(models, name) for name in models.__all__]
ARCHITECTURES = [
    cls
    for cls in _exported
    if isinstance(cls, type) and issubclass(cls, PoseModule) and cls not in (PoseModule, models.ClipModule)
]


def make_model(architecture: type[PoseModule], **settings: object) -> PoseModule:
    """An architecture with its default settings, for a small input, the same weights each time."""
    torch.manual_seed(0)
    if architecture is models.PoseNet:
        small = {"backbone": "tests.models.helpers.SmallCNN", "crop": 12, "input_shape": [3, 12, 12]}
    elif architecture is models.LandmarkMap:
        small = {"input_shape": [WALL_KEYPOINTS, 36]}
    else:
        small = {"input_shape": _INPUT_SHAPES[architecture.input_ranks[0]]}
    model = architecture(**{**small, **settings})  # type: ignore[arg-type]
    if isinstance(model, models.NodePose):
        model.store_training(LearnableProblem(list(model.input_shape)).data.data)
    return model


class SmallCNN(nn.Module):
    """A backbone for small crops, frozen as users' modules may be."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layers = nn.Sequential(nn.Conv2d(3, 32, 4, 4), nn.BatchNorm2d(32), nn.ReLU(), nn.Conv2d(32, 64, 3))
        self.eval().requires_grad_(False)

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        return self.layers(rgb * 255)


def random_poses(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """(count, 3) positions around (5, 0, -2) m, and (count, 4) rotations of up to 60 degrees, w > 0."""
    generator = torch.Generator().manual_seed(seed)
    position_m = torch.randn(count, 3, generator=generator) + torch.tensor([5.0, 0.0, -2.0])
    axis = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    half_angle = torch.rand(count, 1, generator=generator) * math.pi / 6
    return position_m, torch.cat([half_angle.cos(), half_angle.sin() * axis], dim=-1)


def features_for(model: PoseModule, count: int, seed: int = 0) -> torch.Tensor:
    """Random features of frames, or of clips where the model reads those."""
    axes = (CLIP_LENGTH,) if model.reads_clips else ()
    return torch.randn(count, *axes, *model.input_shape, generator=torch.Generator().manual_seed(seed))


def problem_class_for(model: PoseModule) -> type[LearnableProblem]:
    """A problem that the model can learn: of clips where it reads those, of a wall where it reads keypoints."""
    if isinstance(model, models.LandmarkMap):
        return WallProblem
    return ClipProblem if model.reads_clips else LearnableProblem


def problem_for(model: PoseModule) -> LearnableProblem:
    """A problem that the model can learn, for its shape of features."""
    return problem_class_for(model)(list(model.input_shape))


class LearnableProblem(SceneDataModule):
    """Frames whose features are the pose times a fixed random matrix, so that there is all to learn and no noise.

    Validation and test frames follow the same rule, and no frame is in two splits: what is learnt from one split
    differs from what is learnt from another.
    """

    def __init__(self, input_shape: list[int], count: int = 24) -> None:
        SceneDataModule.__init__(self, Thumbnails(), 8, 8, cache_dir=None, workers=None)  # the extractor is not used
        self.count = count  # a checkpoint names the settings of its data
        poses = {split: random_poses(count, seed) for split, seed in _SEEDS.items()}
        train = torch.cat(poses["train"], dim=-1)
        mix = torch.randn(7, math.prod(input_shape), generator=torch.Generator().manual_seed(1)) / 7**0.5
        self.splits = {}
        for number, (split, (position_m, quat_wxyz)) in enumerate(poses.items()):
            pose = (torch.cat([position_m, quat_wxyz], dim=-1) - train.mean(0)) / train.std(0)
            features = (pose @ mix).reshape(count, *input_shape)
            frame = torch.arange(count) + number * count
            self.splits[split] = PoseDataset(PoseBatch(features, position_m, quat_wxyz, frame))
        self.data = self.splits["train"]
        self.learnt = self.data.data

    def prepare_data(self) -> None:
        """There is nothing to extract."""

    def dataset(self, split: str) -> PoseDataset:
        return self.splits[split]

    def train_dataloader(self) -> DataLoader[PoseBatch]:
        return make_loader(self.data, batch_size=8, shuffle=True)

    def val_dataloader(self) -> DataLoader[PoseBatch] | list[DataLoader[PoseBatch]]:
        """None, unless a subclass has one: most tests need no validation."""
        return []


class ClipProblem(LearnableProblem, ClipDataModule):
    """Clips in which every frame shows where it is."""

    def __init__(self, input_shape: list[int], count: int = 24) -> None:
        super().__init__(input_shape, count)
        self.relative_frame = "camera"
        shape = ClipShape(CLIP_LENGTH, hop=1)
        self.clip_splits = {
            split: ClipDataset(frames.data, [np.arange(count)], shape) for split, frames in self.splits.items()
        }
        self.training_clips = self.clip_splits["train"]
        # A frame shows its pose relative to the first frame of its clip, which is the target.
        _, position_m, quat_wxyz, frame = self.training_clips.__getitems__(range(len(self.training_clips)))
        rows, columns = input_shape
        # In patches, because the networks' pools are averages.
        mix = torch.randn(7, -(-rows // 5), -(-columns // 5), generator=torch.Generator().manual_seed(1))
        mix = mix.repeat_interleave(5, 1).repeat_interleave(5, 2)[:, :rows, :columns]
        features = torch.einsum("wtp,prc->wtrc", torch.cat([position_m, quat_wxyz], dim=-1), mix)
        self.learnt = PoseBatch(features, position_m, quat_wxyz, frame)

    def dataset(self, split: str) -> ClipDataset:
        return self.clip_splits[split]

    def train_dataloader(self) -> DataLoader[PoseBatch]:
        return make_loader(PoseDataset(self.learnt), batch_size=8, shuffle=True)


class WallProblem(LearnableProblem):
    """Keypoints of a wall as cameras along it see them, in the form of a local extractor with its geometry.

    Args:
        input_shape: of a frame's features.
        count: frames of each split.
        cameras: of the frames, in turn, in COLMAP's notation, whose images show what each camera sees; None for one
            of `WALL_CAMERA` that is not known.
    """

    def __init__(self, input_shape: list[int], count: int = 12, cameras: Sequence[str | None] = (WALL_CAMERA,)) -> None:
        super().__init__(input_shape, count)
        self.extractor = SURF(input_shape[0], with_geometry=True)
        self.cameras = list(cameras)
        frames, self.splits, self._sizes = [], {}, []
        for number, (split, seed) in enumerate(_SEEDS.items()):
            rotation, position_m = make_walk(count, seed)
            wall = make_frames(rotation, position_m + np.array([0.0, 0.03, 0.02]) * number, seed=seed)
            quats = Rotation.from_matrix(wall.rotation).as_quat(scalar_first=True)
            position_m, quat_wxyz = (torch.from_numpy(pose).float() for pose in (wall.position, quats))
            frame = torch.arange(count) + number * count
            given = [cameras[i % len(cameras)] for i in range(count)]
            seen_by = [Camera.parse(camera or WALL_CAMERA) for camera in given]
            features = torch.from_numpy(wall_features(wall, input_shape[0], seen_by))
            self.splits[split] = PoseDataset(PoseBatch(features, position_m, quat_wxyz, frame))
            image = Path("wall.png")
            frames += [Frame(image, c, q, split, i) for i, (c, q) in enumerate(zip(wall.position, quats, strict=True))]
            self._sizes += [(camera.width, camera.height) for camera in seen_by]
            self._cameras |= {int(i): Camera.parse(c) if c else None for i, c in zip(frame, given, strict=True)}
        self.data = self.splits["train"]
        self.learnt = self.data.data
        splits = {split: part.data.frame.numpy() for split, part in self.splits.items()}
        self._scene = Scene("wall", Path("wall"), "wall", tuple(frames), splits)

    def measure_image(self, frame: int) -> tuple[int, int]:
        return self._sizes[frame]

    def read_features(self, frames: Sequence[int]) -> torch.Tensor:
        data = [self.splits[split].data for split in _SEEDS]
        return torch.cat([part.features for part in data])[list(frames)]


class RefinableProblem(WallProblem):
    """Frames of a wall whose features are (D,) numbers that show the pose roughly, beside the wall's keypoints."""

    def __init__(self, columns: int = 16, count: int = 12) -> None:
        super().__init__([WALL_KEYPOINTS, 36], count)
        self.keypoints = self.splits
        mix = torch.randn(7, columns, generator=torch.Generator().manual_seed(1))
        self.splits = {}
        for split, frames in self.keypoints.items():
            noise = 0.1 * torch.randn(count, columns, generator=torch.Generator().manual_seed(_SEEDS[split]))
            features = torch.cat([frames.data.position_m, frames.data.quat_wxyz], dim=-1) @ mix + noise
            self.splits[split] = PoseDataset(frames.data._replace(features=features))
        self.data = self.splits["train"]
        self.learnt = self.data.data
        self.extractor = Thumbnails()

    def with_extractor(self, extractor: FeatureExtractor) -> SceneDataModule:
        """The wall's keypoints, with descriptors as wide as the extractor's."""
        other = WallProblem([WALL_KEYPOINTS, 36])
        other._scene, other.splits = self.scene, {}
        for split, frames in self.keypoints.items():
            descriptors, places = frames.data.features.split([32, 4], dim=-1)
            wider = torch.zeros(*descriptors.shape[:2], extractor.feature_shape[1] - 36)
            features = torch.cat([descriptors, wider, places], dim=-1)
            other.splits[split] = PoseDataset(frames.data._replace(features=features))
        return other


def wall_features(wall: MapFrames, n: int, cameras: Sequence[Camera]) -> np.ndarray:
    """(F, n, 36) float32: descriptors, x and y in -1 to 1, log2 of size by 16 pixels, response."""
    places = np.stack([camera.project(rays) for camera, rays in zip(cameras, wall.points, strict=True)])
    places = places / np.array([[camera.width, camera.height] for camera in cameras])[:, None] * 2 - 1
    size_px = wall.size_px * (np.array([camera.focal_px for camera in cameras]) / FOCAL_PX)[:, None]
    size = np.log2(np.maximum(size_px, 1) / 16)[..., None]
    rows = np.concatenate([wall.descriptors, places, size, np.zeros_like(size)], axis=2) * wall.real[..., None]
    padded = np.zeros((len(wall), n, rows.shape[2]), np.float32)
    padded[:, : rows.shape[1]] = rows[:, :n]
    return padded
