"""SceneFolders: the settings of a data module that say which scenes it reads, and the scene they make together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from lightning_pose.errors import ConfigError
from lightning_pose.geometry.camera import Camera
from lightning_pose.scenes.cameras import apply_camera
from lightning_pose.scenes.combine import check_one_world, join_scenes
from lightning_pose.scenes.formats import OnBadFrame, load_scene
from lightning_pose.scenes.formats.split_rules import check_split_rule
from lightning_pose.scenes.ground_truth import GroundTruth, apply_ground_truth, check_ground_truth
from lightning_pose.scenes.pose_times import ClockOffsetSetting, PoseTime, check_pose_time, interpolate_scene
from lightning_pose.scenes.scene import Scene

__all__ = ["SceneFolders"]

TEST_FRACTION = 0.2
"""Part of the frames to test on, of a scene that has no official split."""


@dataclass(frozen=True)
class SceneFolders:
    """Which scenes to train, validate and test on. Names are those of the data modules' settings.

    Attributes:
        root: one scene's folder, to use with its own splits; instead of the others.
        train_scenes: folders of the scenes to train on.
        test_scenes: folders of the scenes to test on; the scenes to train on if None.
        val_scenes: folders of the scenes to validate on; part of the training frames if None.
        format: name of the dataset format of all scenes; recognised from each folder if None.
        val_fraction: part of the training frames to validate on.
        ground_truth: as for `apply_ground_truth`.
        pgt: likewise.
        on_bad_frame: as for `load_scene`.
        split: likewise.
        camera: of all frames, in COLMAP's notation; each format's own if None.
        pose_time: `interpolate` poses at the images' times.
        clock_offset_ms: then added to the images' times; `auto` is 0 here, and found later.

    Raises:
        ConfigError: scenes are named in two ways, none to train on is named, or settings contradict each other.
    """

    root: str | None = None
    train_scenes: list[str] | None = None
    test_scenes: list[str] | None = None
    val_scenes: list[str] | None = None
    format: str | None = None
    val_fraction: float = 0.1
    ground_truth: GroundTruth = "original"
    pgt: str | None = None
    on_bad_frame: OnBadFrame = "refuse"
    split: str | None = None
    camera: str | None = None
    pose_time: PoseTime = "nearest"
    clock_offset_ms: ClockOffsetSetting = 0.0

    def __post_init__(self) -> None:
        check_ground_truth(self.ground_truth, self.pgt)
        check_pose_time(self.pose_time, self.clock_offset_ms)
        if self.split is not None:
            check_split_rule(self.split)
        if self.camera is not None:
            Camera.parse(self.camera)
        others = {"test_scenes": self.test_scenes, "val_scenes": self.val_scenes}
        if self.root is not None and (self.train_scenes or any(others.values())):
            raise ConfigError(
                "data.root is one scene, and data.train_scenes, data.val_scenes and data.test_scenes are several; "
                "give either"
            )
        for name, folders in others.items():
            if folders is not None and not self.train_scenes:
                raise ConfigError(f"data.{name} is {folders}, but nothing to train on is named; give data.train_scenes")
            if folders == []:
                raise ConfigError(f"data.{name} is empty; name a scene's folder, or leave it out")
        if self.train_scenes == []:
            raise ConfigError("data.train_scenes is empty; name a scene's folder, or leave it out for synthetic rooms")

    def load(self, rooms: tuple[list[Path], list[Path]] | None, val_block: int = 1, one_world: bool = False) -> Scene:
        """Read the scenes and join them; the rooms to train on and those to test on where no scene is named.

        Args:
            rooms: folders of synthetic rooms.
            val_block: least number of consecutive validation frames, if sequences are that long.
            one_world: refuse scenes whose positions are in different worlds.

        Raises:
            ConfigError: scenes are in different worlds, or validated on and used otherwise too.
            DataError: a scene cannot be read.
        """
        learned, asked, validated = self.train_scenes, self.test_scenes, self.val_scenes or []
        if self.root is not None:
            learned = asked = [self.root]
        elif learned is None and rooms is not None:
            learned, asked = ([str(room) for room in part] for part in rooms)
        held_out = 0.0 if validated else self.val_fraction
        asked = learned if asked is None else asked
        tested = {_resolve_folder(folder) for folder in asked or []}
        read = cache(partial(self._load, val_block=val_block))
        train = [read(folder, held_out, _resolve_folder(folder) in tested) for folder in learned or []]
        test = [read(folder, held_out, True) for folder in asked or []]
        val = [read(folder, 0.0, False) for folder in validated]
        if one_world:
            check_one_world([*train, *test, *val])
        return join_scenes(train, test, val)

    def _load(self, folder: str, val_fraction: float, tested: bool, val_block: int) -> Scene:
        """Read a folder with the ground truth asked for; one that is not tested on keeps all its frames for training.

        An official test split stays apart even then.
        """
        test_fraction = TEST_FRACTION if tested else 0.0
        scene = load_scene(folder, self.format, val_fraction, test_fraction, val_block, self.on_bad_frame, self.split)
        scene = apply_ground_truth(scene, self.ground_truth, self.pgt)
        if self.pose_time == "interpolate":
            scene = interpolate_scene(scene, 0.0 if self.clock_offset_ms == "auto" else self.clock_offset_ms)
        return scene if self.camera is None else apply_camera(scene, Camera.parse(self.camera))


def _resolve_folder(folder: str) -> Path:
    """The folder's one true path, for comparisons."""
    return Path(folder).expanduser().resolve()
