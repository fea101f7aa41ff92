"""MapRefinement: a landmark map beside a regressor, whose pose replaces the regressor's where the map accepts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from torch import Tensor, nn

from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.errors import ConfigError
from lightning_pose.features import AKAZE, BRIEF, FREAK, ORB, SIFT, SURF, LocalExtractor
from lightning_pose.mapping.map_localizer import MapAnswer
from lightning_pose.models.parts.frame_cameras import list_cameras
from lightning_pose.models.parts.map_builder import BundleAdjust, MapBuilder, check_bundle_adjust
from lightning_pose.models.parts.map_network import RESIZED, MapNetwork
from lightning_pose.models.parts.memory import resize_tensors
from lightning_pose.models.parts.world_frame import WorldFrame

__all__ = ["MapRefinement", "MapSettings"]

Keypoints = Literal["SURF", "SIFT", "ORB", "AKAZE", "FREAK", "BRIEF"]

EXTRACTORS: dict[Keypoints, type[LocalExtractor]] = {
    "SURF": SURF, "SIFT": SIFT, "ORB": ORB, "AKAZE": AKAZE, "FREAK": FREAK, "BRIEF": BRIEF,
}  # fmt: skip


@dataclass
class MapSettings:
    """Settings of the landmark map behind a regressor.

    Attributes:
        keypoints: the extractor of the map's keypoints, whatever the regressor reads.
        n_features: keypoints of a frame.
        bundle_adjust: as for `LandmarkMap`.

    Raises:
        ConfigError: a value is out of its range.
    """

    keypoints: Keypoints = "SURF"
    n_features: int = 300
    bundle_adjust: BundleAdjust = "auto"

    def __post_init__(self) -> None:
        if self.keypoints not in get_args(Keypoints):
            raise ConfigError(f"keypoints is {self.keypoints!r}; give one of {', '.join(get_args(Keypoints))}")
        check_bundle_adjust(self.bundle_adjust)

    @classmethod
    def parse(cls, refine: bool | MapSettings | Mapping[str, Any]) -> MapSettings | None:
        """Settings from what a config or a checkpoint has; None for `false`."""
        if isinstance(refine, Mapping):
            return cls(**refine)
        return (cls() if refine else None) if isinstance(refine, bool) else refine


class MapRefinement(nn.Module):
    """A landmark map, the extractor of its keypoints, and the data module that has them of a trainer's frames.

    Args:
        settings: of the map.
    """

    def __init__(self, settings: MapSettings) -> None:
        super().__init__()
        self.settings = settings
        self.extractor = EXTRACTORS[settings.keypoints](settings.n_features, with_geometry=True)
        self.network = MapNetwork(self.extractor.descriptor_dim)
        self._keypoints: SceneDataModule | None = None
        self._builder: MapBuilder | None = None
        self._answers: dict[int, MapAnswer] = {}
        self.register_load_state_dict_pre_hook(_resize_before_load)

    @property
    def has_map(self) -> bool:
        """Whether a map has been built or loaded."""
        return len(self.network.position) > 0

    def attach(self, datamodule: SceneDataModule, world_frame: WorldFrame, say: Callable[[str], None]) -> None:
        """Take keypoints of the frames of a data module from now on.

        Args:
            datamodule: of the regressor.
            world_frame: of the regressor; the map has the same.
            say: takes lines for the user.
        """
        self._keypoints = datamodule.with_extractor(self.extractor)
        self._answers = {}
        self._builder = MapBuilder(self.network, self._keypoints, world_frame, self.settings.bundle_adjust, say)

    def fit(self, splits: tuple[str, ...], calibrate: bool) -> None:
        """Build the map of the frames of these splits; `calibrate` finds the radii of its answers too."""
        assert self._builder is not None, "attach comes first"
        self._builder.build(splits, calibrate)
        self._answers = {}

    def read_keypoints(self, frames: Sequence[int]) -> Tensor:
        """(M, N, D + 4) keypoints of frames of the data module."""
        assert self._keypoints is not None, "attach comes first"
        return self._keypoints.read_features(frames)

    def locate_frames(self, frames: Sequence[int]) -> list[MapAnswer]:
        """The map's answers for frames of the data module; it is asked once for each."""
        assert self._keypoints is not None, "attach comes first"
        new = [frame for frame in dict.fromkeys(frames) if frame not in self._answers]
        if new:
            cameras = list_cameras(self._keypoints, new, self.network.view)
            self._answers |= zip(new, self.network.locate(self.read_keypoints(new), cameras), strict=True)
        return [self._answers[frame] for frame in frames]

    def resize_map(self, state_dict: Mapping[str, Tensor]) -> None:
        """Give the map the size that it has in a state dict."""
        self._answers = {}
        resize_tensors(self, (f"network.{name}" for name in RESIZED), state_dict)


def _resize_before_load(module: nn.Module, state_dict: dict[str, Tensor], prefix: str, *_: object) -> None:
    """`load_state_dict` of the module that holds it calls this before it copies anything."""
    assert isinstance(module, MapRefinement)
    module.resize_map({name.removeprefix(prefix): value for name, value in state_dict.items()})
