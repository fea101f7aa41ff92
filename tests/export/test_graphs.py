"""Each architecture as ONNX: the same poses and radii, to rounding."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import functional as F

pytest.importorskip("onnxscript", reason="the extra `export` is not installed")

from lightning_pose import models
from lightning_pose.data.batches import PoseBatch
from lightning_pose.errors import ConfigError
from lightning_pose.export.onnx_files import write_onnx
from lightning_pose.export.quantize import quantize_file
from lightning_pose.export.runner.clips import FrameFollower, chain_clips
from lightning_pose.export.runner.network import Network, fit_pixels
from lightning_pose.features import CNN, SURF, FeatureExtractor, Pixels
from lightning_pose.localization.sequences import ClipFollower, locate_sequence
from lightning_pose.models import (
    CNN3D,
    CNNRNN,
    DensePoseNet,
    GraphPose,
    KernelPoseNet,
    LinearPoseNet,
    NodePose,
    PoseModule,
    PoseNet,
    SurfCNN,
    SurfLSTM,
)
from tests.export.helpers import BACKBONE, COLUMNS

TRAINING = 30
"""Images that a model keeps something of."""


def make_cnn(output: str = "vector") -> CNN:
    return CNN(BACKBONE, output=output, size=32)  # type: ignore[arg-type]


def fill(model: PoseModule, low: float = 0.0, high: float = 1.0) -> PoseModule:
    """Give a model a scale, an origin, and training images, as a fit does."""
    torch.manual_seed(0)
    features = torch.rand(TRAINING, *model.input_shape) * (high - low) + low
    model.pose_mean.copy_(torch.rand(7))
    model.pose_scale.copy_(torch.rand(7) + 0.5)
    model.world_frame.scale = 2.0
    if not model.reads_clips:
        model.world_frame.origin = torch.tensor([1e6, 2.0, -3.0], dtype=torch.float64)
    if model.radius is not None:
        model.radius.set_training(features)
        model.radius.factors.copy_(torch.tensor([0.3, 2.0]))
        model.radius.floor.fill_(0.1)
        model.radius.farthest.fill_(0.2)
    if isinstance(model, KernelPoseNet):
        model.network.set_landmarks(features, 0.2)
        model.network.weight.data.normal_()
    if isinstance(model, NodePose):
        quats = F.normalize(torch.rand(TRAINING, 4), dim=1)
        frames = torch.arange(TRAINING)
        model.store_training(PoseBatch(features, torch.rand(TRAINING, 3).double(), quats, frames))
    return model.eval()


IMAGES: dict[str, tuple[Callable[[], PoseModule], Callable[[], FeatureExtractor]]] = {
    "SurfLSTM": (lambda: SurfLSTM(input_shape=[20, 64], units=8, layers=2), lambda: SURF(20)),
    "SurfLSTM gru": (lambda: SurfLSTM(input_shape=[20, 64], cell="gru", units=8, layers=1), lambda: SURF(20)),
    "SurfCNN": (lambda: SurfCNN(input_shape=[20, 64], units=8, channels=[4] * 5), lambda: SURF(20)),
    "SurfCNN unordered": (
        lambda: SurfCNN(input_shape=[20, 64], units=8, channels=[4] * 5, ordered=False),
        lambda: SURF(20),
    ),
    "LinearPoseNet": (lambda: LinearPoseNet(input_shape=[COLUMNS]), make_cnn),
    "DensePoseNet": (lambda: DensePoseNet(input_shape=[COLUMNS], components=5), make_cnn),
    "KernelPoseNet": (lambda: KernelPoseNet(input_shape=[COLUMNS]), make_cnn),
    "NodePose": (lambda: NodePose(input_shape=[COLUMNS], neighbours=3, channels=[8, 8]), make_cnn),
    "NodePose gcn": (lambda: NodePose(input_shape=[COLUMNS], neighbours=3, channels=[8, 8], conv="gcn"), make_cnn),
    "GraphPose": (
        lambda: GraphPose(input_shape=[COLUMNS, 4, 4], channels=[8, 8], neighbours=2, places=True),
        lambda: CNN(BACKBONE, output="map", size=64, crop="whole"),
    ),
    "PoseNet": (
        lambda: PoseNet(input_shape=[3, 40, 52], crop=32, weights="none", units=8),
        lambda: Pixels(40, 52),
    ),
}

CLIPS: dict[str, Callable[[], PoseModule]] = {
    "CNNRNN": lambda: CNNRNN(input_shape=[12, 68], channels=4, units=8),
    "CNNRNN integrated": lambda: CNNRNN(input_shape=[12, 68], channels=4, units=8, motion=True, integrate=True),
    "CNN3D": lambda: CNN3D(input_shape=[12, 68], channels=4, units=8),
}


def test_every_architecture_is_here() -> None:
    tested = {name.split()[0] for name in (*IMAGES, *CLIPS)}
    assert tested == set(models.__all__) - {"PoseModule", "LandmarkMap", "ClipModule", "Pose", "Located"}


@pytest.mark.parametrize("name", IMAGES)
def test_images_get_the_same_answers(name: str, tmp_path: Path) -> None:
    make_model, make_extractor = IMAGES[name]
    extractor = make_extractor()
    model = fill(make_model(), high=255.0 if isinstance(extractor, Pixels) else 1.0)
    write_onnx(model, extractor, tmp_path / "model.onnx")
    network = Network(tmp_path / "model.onnx")
    rng = np.random.default_rng(0)
    for shape in ((48, 64), (90, 50)):
        image = rng.integers(0, 256, (*shape, 3) if extractor.color == "rgb" else shape, dtype=np.uint8)
        features = extractor.features(extractor.extract([image])[0])
        given = image if isinstance(extractor, CNN) else features[None]
        if isinstance(extractor, Pixels):
            np.testing.assert_array_equal(fit_pixels(image, 40, 52), features)
        found = network.locate(given)
        batch = torch.from_numpy(features[None])
        with torch.inference_mode():
            pose = model(batch)
            assert model.radius is not None
            radii = [float(radius[0]) for radius in model.radius.find_radii(batch)]
            excess = float(model.radius.measure_excess(batch)[0])
        np.testing.assert_allclose(found.position_m, pose.position_m[0], atol=2e-4)
        np.testing.assert_allclose(found.quat_wxyz, pose.quat_wxyz[0], atol=2e-4)
        np.testing.assert_allclose([found.radius_m, found.radius_deg, found.excess], [*radii, excess], rtol=1e-3)


@pytest.mark.parametrize("name", ["DensePoseNet", "CNNRNN"])
def test_weights_of_eight_bits_answer_almost_the_same(name: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    clips = name == "CNNRNN"
    model = CNNRNN(input_shape=[12, 68], channels=16, units=24) if clips else DensePoseNet(input_shape=[COLUMNS])
    write_onnx(fill(model), SURF(12, with_geometry=True) if clips else make_cnn(), tmp_path / "model.onnx")
    quantize_file(tmp_path / "model.onnx", tmp_path / "small.onnx")
    whole, small = (tmp_path / file for file in ("model.onnx", "small.onnx"))
    assert small.stat().st_size < 0.5 * whole.stat().st_size
    if clips:
        given = torch.rand(1, 4, 12, 68).numpy()
        before, after = (np.concatenate(Network(file).locate_clip(given), axis=1) for file in (whole, small))
    else:
        given = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        found = [Network(file).locate(given) for file in (whole, small)]
        before, after = (np.concatenate([pose.position_m - 1e6 * np.eye(3)[0], pose.quat_wxyz]) for pose in found)
    assert not np.array_equal(before, after)
    np.testing.assert_allclose(before, after, atol=0.03)


@pytest.mark.parametrize("name", CLIPS)
def test_videos_get_the_same_answers(name: str, tmp_path: Path) -> None:
    model = fill(CLIPS[name]())
    write_onnx(model, SURF(12, with_geometry=True), tmp_path / "model.onnx")
    network = Network(tmp_path / "model.onnx")
    frames = torch.rand(9, 12, 68)
    settings: dict[str, Any] = {"length": 4, "in_camera": True, "integrate": bool(model.integrate)}
    expected_m, expected_quat = locate_sequence(model, frames, 4)
    position_m, quat_wxyz = chain_clips(
        9, locate=lambda part: network.locate_clip(frames[None, part].numpy()), **settings
    )
    np.testing.assert_allclose(position_m, expected_m, atol=1e-4)
    np.testing.assert_allclose(np.abs((quat_wxyz * expected_quat.numpy()).sum(1)), 1, atol=1e-6)
    live, followed = FrameFollower(locate=lambda part: network.locate_clip(np.stack(part)[None]), **settings), None
    followed = ClipFollower(model, 4)
    for frame in frames:
        found, expected = live.add(frame.numpy()), followed.add(frame)
        np.testing.assert_allclose(found[0], expected[0], atol=1e-4)


@pytest.mark.parametrize("name", ["CNNRNN", "CNN3D"])
def test_axes_of_the_world_and_a_single_frame(name: str) -> None:
    model, frames = fill(CLIPS[name]()), torch.rand(3, 12, 68)

    def locate(part: slice) -> tuple[np.ndarray, np.ndarray]:
        pose = model(frames[None, part])
        return pose.position_m[0].detach().numpy(), pose.quat_wxyz[0].detach().numpy()

    for count, axes in ((1, "camera"), (3, "world")):
        expected, _ = locate_sequence(model, frames[:count], 2, axes)  # type: ignore[arg-type]
        found, _ = chain_clips(count, 2, axes == "camera", False, locate)
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    class Branching(LinearPoseNet):
        def decode_features(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return super().decode_features(features + 1 if float(features.sum()) > 0 else features)

    with pytest.raises(ConfigError, match=r"^Branching with these settings cannot be written as ONNX: "):
        write_onnx(fill(Branching(input_shape=[8])), SURF(8), tmp_path / "model.onnx")
    with pytest.raises(ConfigError, match="CNN3D of CNN maps cannot be exported"):
        write_onnx(CNN3D(input_shape=[4, 5, 5]), make_cnn("map"), tmp_path / "model.onnx")
    assert not list(tmp_path.iterdir())
