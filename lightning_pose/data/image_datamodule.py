"""ImageDataModule: single posed images of one scene."""

from __future__ import annotations

from copy import copy
from pathlib import Path

from torch.utils.data import DataLoader

from lightning_pose.data.batches import DrawnDataset, PoseBatch, make_loader
from lightning_pose.data.datamodule import SceneDataModule, room_folder
from lightning_pose.errors import ConfigError
from lightning_pose.features import FeatureCache, FeatureExtractor, LocalExtractor
from lightning_pose.scenes.formats import OnBadFrame, load_scene
from lightning_pose.scenes.scene import Scene

__all__ = ["ImageDataModule"]


class ImageDataModule(SceneDataModule):
    """Single posed images of one scene, as features.

    Args:
        extractor: what the networks read, such as `lightning_pose.features.SURF`.
        root: the scene's folder; none renders the synthetic room on first use.
        format: name of the dataset format; recognised from the folder if not given.
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

    Raises:
        ConfigError: a number is out of its range.
        DataError: the scene cannot be read, or a split that is needed is empty.
    """

    def __init__(
        self,
        extractor: FeatureExtractor,
        root: str | None = None,
        format: str | None = None,
        val_fraction: float = 0.1,
        batch_size: int = 64,
        eval_batch_size: int = 256,
        feature_pool: float | None = None,
        cache_dir: str | None = None,
        workers: int | None = None,
        room_seed: int = 0,
        room_frames: int = 300,
        on_bad_frame: OnBadFrame = "refuse",
    ) -> None:
        super().__init__(extractor, batch_size, eval_batch_size, cache_dir, workers)
        self.root = root
        self.format = format
        self.val_fraction = val_fraction
        self.feature_pool = feature_pool
        self._pool = None if feature_pool is None else _widen_extractor(extractor, feature_pool)
        self.room_seed = room_seed
        self.room_frames = room_frames
        self.on_bad_frame: OnBadFrame = on_bad_frame

    def _load_scene(self) -> Scene:
        root = Path(self.root) if self.root is not None else room_folder(self.room_seed, self.room_frames)
        return load_scene(root, self.format, self.val_fraction, on_bad_frame=self.on_bad_frame)

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
