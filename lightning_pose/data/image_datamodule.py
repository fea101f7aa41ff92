"""ImageDataModule: single posed images of one scene, or of several recordings in one world."""

from __future__ import annotations

from copy import copy

from torch.utils.data import DataLoader

from lightning_pose.data.batches import DrawnDataset, PoseBatch, make_loader
from lightning_pose.data.datamodule import SceneDataModule, room_folder
from lightning_pose.data.scene_folders import SceneFolders
from lightning_pose.errors import ConfigError
from lightning_pose.features import FeatureCache, FeatureExtractor, LocalExtractor
from lightning_pose.scenes.formats import OnBadFrame
from lightning_pose.scenes.ground_truth import GroundTruth
from lightning_pose.scenes.pose_times import ClockOffsetSetting, PoseTime
from lightning_pose.scenes.scene import Scene

__all__ = ["ImageDataModule"]


class ImageDataModule(SceneDataModule):
    """Single posed images of one scene, as features.

    Recordings to train and to test on can be given separately, if their positions are in one world: those of TUM RGB-D
    and ICL-NUIM of one place are. A recording that is only for testing gives its official test split, or all of its
    frames if it has none.

    Args:
        extractor: what the networks read, such as `lightning_pose.features.SURF`.
        root: the scene's folder; none renders the synthetic room on first use.
        train_scenes: folders of the recordings to train on; instead of `root`.
        test_scenes: folders of the recordings to test on; those to train on if not given.
        val_scenes: folders of the recordings to validate on; part of the training frames if not given.
        format: name of the dataset format of all folders; recognised from each folder if not given.
        ground_truth: `original`, as the dataset has it; `registered`, moved to the colour camera (7-Scenes); or `sfm`,
            from `pgt`.
        pgt: folder of the pseudo ground truth of Brachmann et al. (ICCV 2021), which holds sfm/7scenes/SCENE_train.txt.
        camera: of all images, as `MODEL,WIDTH,HEIGHT,PARAMETERS...` in COLMAP's notation, with the centre of the first
            pixel at (0, 0); such as PINHOLE,640,480,525,525,319.5,239.5. That of the dataset if not given.
        pose_time: which pose an image has, where the dataset has poses by time (TUM RGB-D): the `nearest`, as is usual,
            or `interpolate`d at the image's own time.
        clock_offset_ms: with `interpolate`, milliseconds from an image's time to its pose's; `auto` finds those under
            which the training frames fit best. Errors are then under another ground truth, which is named so.
        val_fraction: part of the training split kept for validation, in whole blocks of the trajectory; 0 for none.
        batch_size: frames in a training batch.
        eval_batch_size: frames in a batch where no gradient is needed.
        feature_pool: in training, draw the N features of each frame at random from so many times N of its strongest,
            anew in every epoch, so that the network cannot memorise frames; validation and test read the N strongest.
            None never draws. For extractors of local features only; the pool ends with the 300 that the cache holds.
        cache_dir: where extracted features are kept; the user's cache folder if not given.
        workers: processes or threads that extract features; every core if not given.
        room_seed: which synthetic room.
        room_frames: how many frames of it.
        on_bad_frame: `refuse` a scene with frames whose pose or image is missing or useless, or `drop` these frames and
            say how many there are.
        split: which frames to test on: `every_5` (any number), `folders:NAME,NAME`, `blocks`, or a text file with
            `IMAGE train|val|test` in each line; the format's own split, or blocks, if not given.

    Raises:
        ConfigError: a number is out of its range, scenes are named in two ways, or are in different worlds.
        DataError: the scene cannot be read, or a split that is needed is empty.
    """

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
        val_fraction: float = 0.1,
        batch_size: int = 64,
        eval_batch_size: int = 256,
        feature_pool: float | None = None,
        cache_dir: str | None = None,
        workers: int | None = None,
        room_seed: int = 0,
        room_frames: int = 300,
        on_bad_frame: OnBadFrame = "refuse",
        split: str | None = None,
    ) -> None:
        super().__init__(extractor, batch_size, eval_batch_size, cache_dir, workers)
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
        self.val_fraction = val_fraction
        self.feature_pool = feature_pool
        self._pool = None if feature_pool is None else _widen_extractor(extractor, feature_pool)
        self.room_seed = room_seed
        self.room_frames = room_frames
        self.on_bad_frame: OnBadFrame = on_bad_frame
        self.split = split

    def _load_scene(self) -> Scene:
        rooms = None
        if self.root is None and self.train_scenes is None:
            room = [room_folder(self.room_seed, self.room_frames)]
            rooms = room, room
        return self._folders.load(rooms, one_world=True)

    def train_dataloader(self) -> DataLoader[PoseBatch]:
        train = self.dataset("train")
        if self._pool is not None:
            pool = self._read("train", FeatureCache(self._pool, self.cache_dir))
            train = DrawnDataset(pool, self.input_shape[0])
        return make_loader(train, self.batch_size, shuffle=True)


def _widen_extractor(extractor: FeatureExtractor, times: float) -> LocalExtractor:
    """The extractor with so many times its features per frame, out of the same cache."""
    if not isinstance(extractor, LocalExtractor):
        raise ConfigError(f"data.feature_pool needs local features, and {extractor.name} has none; leave it out")
    if not times >= 1:
        raise ConfigError(f"data.feature_pool is {times}; give how many times n_features it holds, such as 1.5")
    pooled = copy(extractor)
    pooled.n_features = round(min(times * extractor.n_features, extractor.n_stored))
    return pooled
