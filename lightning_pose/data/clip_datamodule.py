"""ClipDataModule: clips of consecutive frames, of one scene or several."""

from __future__ import annotations

import logging
from typing import ClassVar, cast

from torch.utils.data import DataLoader

from lightning_pose.data.batches import PoseBatch, make_loader
from lightning_pose.data.clip_dataset import Augmentation, ClipDataset, ClipShape, find_runs
from lightning_pose.data.datamodule import SceneDataModule, room_folder
from lightning_pose.data.scene_folders import SceneFolders
from lightning_pose.errors import ConfigError
from lightning_pose.features import FeatureExtractor
from lightning_pose.geometry.relative import RelativeFrame, check_relative_frame
from lightning_pose.scenes.formats import OnBadFrame
from lightning_pose.scenes.gaps import describe_gaps
from lightning_pose.scenes.ground_truth import GroundTruth
from lightning_pose.scenes.pose_times import ClockOffsetSetting, PoseTime
from lightning_pose.scenes.scene import Scene

__all__ = ["ClipDataModule", "require_clips"]

_log = logging.getLogger("lightning_pose")

LONGEST = 400
"""Frames of the longest clip that the thesis tests."""


class ClipDataModule(SceneDataModule):
    """Clips of T consecutive frames of one sequence, with poses relative to each clip's first frame (eq. 6.1).

    Scenes to train and to test on are given separately, so that a network can be tested on scenes that it was not
    trained on. A scene that is only for testing gives its official test split, or all of its frames if it has none.
    Without scenes, training is on synthetic rooms and the test on another.

    Args:
        extractor: what the networks read of each frame, such as `lightning_pose.features.SURF`.
        root: one scene's folder, to train and test on its own splits; instead of `train_scenes`.
        train_scenes: folders of the scenes to train on.
        test_scenes: folders of the scenes to test on; the scenes to train on if not given.
        val_scenes: folders of the scenes to validate on; part of the training frames if not given.
        format: name of the dataset format of all scenes; recognised from each folder if not given.
        ground_truth: `original`, as the dataset has it; `registered`, moved to the colour camera (7-Scenes); or `sfm`,
            from `pgt`.
        pgt: folder of the pseudo ground truth of Brachmann et al. (ICCV 2021), which holds sfm/7scenes/SCENE_train.txt.
        camera: of all images, as `MODEL,WIDTH,HEIGHT,PARAMETERS...` in COLMAP's notation, with the centre of the first
            pixel at (0, 0); such as PINHOLE,640,480,525,525,319.5,239.5. That of the dataset if not given.
        pose_time: which pose an image has, where the dataset has poses by time (TUM RGB-D): the `nearest`, as is usual,
            or `interpolate`d at the image's own time.
        clock_offset_ms: with `interpolate`, milliseconds from an image's time to its pose's; `auto` finds those under
            which the training frames fit best. Errors are then under another ground truth, which is named so.
        clip_length: T, 2 to 400.
        stride: from one frame of a clip to the next.
        hop: from the first frame of a clip to that of the next; by default clips share one frame, so that they chain.
            In training clips begin up to a hop later, at random.
        relative_frame: axes of relative positions: `camera`, the first camera's, or `world`, as eq. 6.1 has them,
            which no network can infer in a scene that it was not trained on.
        max_stride: in training, take every k-th frame, k drawn up to this, so that the camera moves faster than it did;
            1 or `stride` for none.
        reverse: in training, play half of the clips backwards.
        mirror: in training, mirror half of the clips; for upright SURF descriptors and pixels.
        val_fraction: part of the training frames kept for validation, in blocks of a clip's span at least; 0 for none.
        batch_size: clips in a training batch.
        eval_batch_size: clips in a batch where no gradient is needed.
        cache_dir: where extracted features are kept; the user's cache folder if not given.
        workers: processes or threads that extract features; every core if not given.
        train_rooms: which synthetic rooms to train on, where no scene is given.
        test_rooms: which to test on.
        room_frames: how many frames of each.
        on_bad_frame: `refuse` a scene with frames whose pose or image is missing or useless, or `drop` these frames and
            say how many there are.
        split: which frames to test on: `every_5` (any number), `folders:NAME,NAME`, `blocks`, or a text file with
            `IMAGE train|val|test` in each line; the format's own split, or blocks, if not given.

    Raises:
        ConfigError: a number is out of its range, or scenes are named in two ways.
        DataError: a scene cannot be read, or no run of consecutive frames is as long as a clip.
    """

    gives_clips: ClassVar[bool] = True

    def __init__(
        self,
        extractor: FeatureExtractor,
        root: str | None = None,
        train_scenes: list[str] | None = None,
        test_scenes: list[str] | None = None,
        val_scenes: list[str] | None = None,
        format: str | None = None,
        ground_truth: GroundTruth = "original",
        pgt: str | None = None,
        camera: str | None = None,
        pose_time: PoseTime = "nearest",
        clock_offset_ms: ClockOffsetSetting = 0.0,
        clip_length: int = 10,
        stride: int = 1,
        hop: int | None = None,
        relative_frame: RelativeFrame = "camera",
        max_stride: int = 1,
        reverse: bool = False,
        mirror: bool = False,
        val_fraction: float = 0.1,
        batch_size: int = 16,
        eval_batch_size: int = 16,
        cache_dir: str | None = None,
        workers: int | None = None,
        train_rooms: list[int] = [0],  # noqa: B006  (never changed; shown as it is in --help)
        test_rooms: list[int] = [1],  # noqa: B006
        room_frames: int = 300,
        on_bad_frame: OnBadFrame = "refuse",
        split: str | None = None,
    ) -> None:
        super().__init__(extractor, batch_size, eval_batch_size, cache_dir, workers)
        check_relative_frame(relative_frame)
        if clip_length > LONGEST:
            raise ConfigError(f"data.clip_length is {clip_length}; give 2 to {LONGEST} frames")
        self._shape = ClipShape(clip_length, stride, hop)
        self._folders = SceneFolders(
            root,
            train_scenes,
            test_scenes,
            val_scenes,
            format,
            val_fraction,
            ground_truth,
            pgt,
            on_bad_frame,
            split,
            camera,
            pose_time,
            clock_offset_ms,
        )
        self.root = root
        self.train_scenes = train_scenes
        self.test_scenes = test_scenes
        self.val_scenes = val_scenes
        self.format = format
        self.ground_truth: GroundTruth = ground_truth
        self.pgt = pgt
        self.camera = camera
        self.pose_time: PoseTime = pose_time
        self.clock_offset_ms: ClockOffsetSetting = clock_offset_ms
        self.clip_length = clip_length
        self.stride = stride
        self.hop = hop
        self.relative_frame: RelativeFrame = relative_frame
        self.reverse = reverse
        self.mirror = mirror
        self.max_stride = max_stride
        if mirror:
            extractor.check_mirror()
        self.val_fraction = val_fraction
        self.train_rooms = train_rooms
        self.test_rooms = test_rooms
        self.room_frames = room_frames
        self.on_bad_frame: OnBadFrame = on_bad_frame
        self.split = split

    def _load_scene(self) -> Scene:
        rooms = None
        if self.root is None and self.train_scenes is None:
            learned, asked = (
                [room_folder(seed, self.room_frames) for seed in seeds] for seeds in (self.train_rooms, self.test_rooms)
            )
            rooms = learned, asked
        scene = self._folders.load(rooms, val_block=self._shape.span)
        gaps = describe_gaps(scene)
        if gaps is not None:
            _log.warning("%s: %s", scene.name, gaps)
        return scene

    def dataset(self, split: str) -> ClipDataset:
        """One of `train`, `val`, `test` as clips, without augmentation."""
        return cast(ClipDataset, super().dataset(split))

    def _make_dataset(self, split: str, data: PoseBatch) -> ClipDataset:
        return self._cut_clips(split, data, self._shape)

    def clips(self, split: str, length: int) -> ClipDataset:
        """A split's clips of another length.

        Raises:
            DataError: no run of consecutive frames is that long.
        """
        return self._cut_clips(split, self.dataset(split).data, ClipShape(length, self.stride))

    def longest_clip(self, split: str) -> int:
        """The most frames that a clip of a split can have."""
        runs = find_runs(self.scene, self.scene.splits[split])
        return max(((len(run) - 1) // self.stride + 1 for run in runs), default=0)

    def _cut_clips(
        self, split: str, data: PoseBatch, shape: ClipShape, augmentation: Augmentation | None = None
    ) -> ClipDataset:
        runs = find_runs(self.scene, self.scene.splits[split])
        return ClipDataset(data, runs, shape, self.relative_frame, augmentation)

    def train_dataloader(self) -> DataLoader[PoseBatch]:
        data = self.dataset("train").data
        clips = self._cut_clips("train", data, self._shape, self._augmentation())
        return make_loader(clips, self.batch_size, shuffle=True)

    def _augmentation(self) -> Augmentation:
        """The random changes to training clips that the settings ask for."""
        return Augmentation(True, self.max_stride, self.reverse, self.extractor.mirror if self.mirror else None)


def require_clips(datamodule: SceneDataModule) -> ClipDataModule:
    """The same data module, as one of clips.

    Raises:
        ConfigError: it gives single images.
    """
    if not isinstance(datamodule, ClipDataModule):
        raise ConfigError(
            f"{type(datamodule).__name__} gives images, not clips; set data.class_path to "
            "lightning_pose.data.ClipDataModule"
        )
    return datamodule
