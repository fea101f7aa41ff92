"""The offset between the clocks of a recording's images and poses, found on its training frames."""

from __future__ import annotations

import numpy as np
from lightning.fabric.utilities.rank_zero import rank_zero_only
from scipy.spatial.transform import Rotation

from lightning_pose.data.datamodule import SceneDataModule
from lightning_pose.errors import DataError
from lightning_pose.features.cache import FeatureCache
from lightning_pose.features.surf import SURF
from lightning_pose.mapping.clock_offset import fit_clock_offset
from lightning_pose.mapping.conventions import fit_focal_length
from lightning_pose.mapping.frame_matches import match_nearby_frames

__all__ = ["find_clock_offset_ms"]

MAX_OFFSET_S, STEP_S = 0.04, 0.005
ANCHORS = 60
"""Training frames from which later ones are matched."""


def find_clock_offset_ms(datamodule: SceneDataModule) -> float:
    """Milliseconds from an image's time to its pose's, under which training frames fit their poses best; printed.

    SURF keypoints are matched, whatever features the data module has, so that the ground truth does not depend on them.

    Args:
        datamodule: of a scene with a trajectory.

    Raises:
        DataError: too few training frames match each other.
    """
    scene = datamodule.scene
    train = scene.splits["train"].tolist()
    frames = [scene.frames[i] for i in train]
    cache = FeatureCache(SURF(300), datamodule.cache_dir)
    records = list(cache.records([frame.image for frame in frames], datamodule.workers))
    cameras = [datamodule.find_camera(i) for i in train]
    known = [camera.focal_px for camera in cameras if camera is not None]
    focal_px = float(np.median(known)) if known else 1.0

    def read_keypoints(i: int) -> tuple[np.ndarray, np.ndarray]:
        record, camera = records[i], cameras[i]
        count = int(record["count"])
        pixels = record["keypoints"][:count, :2].astype(np.float64)
        points = pixels - (record["image_size"] - 1) / 2 if camera is None else camera.normalize(pixels) * focal_px
        return points, record["descriptors"][:count]

    matches = match_nearby_frames([frame.sequence for frame in frames], read_keypoints, ANCHORS)
    if not known:
        rotation = Rotation.from_quat([frame.quat_wxyz for frame in frames], scalar_first=True).as_matrix()
        position = np.array([frame.position_m for frame in frames])
        width = max(datamodule.find_image_size("train"))
        focal_px = fit_focal_length(matches, rotation, position, width)[2]
    times_s = np.array([frame.timestamp for frame in frames], np.float64)
    assert scene.trajectory is not None, "interpolate_scene refuses such a scene"
    found = fit_clock_offset(matches, times_s, scene.trajectory, focal_px, MAX_OFFSET_S, STEP_S)
    if found is None or not np.isfinite(found.residual_px):
        raise DataError(
            f"{scene.root}: too few training frames match each other to find the offset of the clocks; give "
            "data.clock_offset_ms, such as 0"
        )
    offset_ms = round(1000 * found.offset_s)
    if rank_zero_only.rank == 0:
        print(
            f"clocks: poses at {offset_ms:+d} ms of the images' times fit the training frames best (cost "
            f"{found.cost:.3f}, {found.cost_at_zero:.3f} at 0 ms); errors are under the poses at these times"
        )
    return float(offset_ms)
