"""Runs pycolmap's mappers, in a process of their own: they print, and may end the process that they run in.

`python -m lightning_pose.reconstruction.mapper METHOD DATABASE OUT THREADS FIXED [MODEL]` writes OUT/0, OUT/1, ...
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Literal

from lightning_pose.errors import DataError

__all__ = ["Method", "run_mapper"]

Method = Literal["global", "incremental"]

SEED = 0


def run_mapper(
    method: Method, database: Path, out: Path, threads: int, fixed: bool, model: Path | None = None
) -> list[Path]:
    """Map the images of a database.

    Args:
        method: `global` (all cameras at once; Pan et al., "GLOMAP", ECCV 2024) or `incremental` (one image after the
            other; Schoenberger & Frahm, CVPR 2016).
        database: with verified pairs; `global` changes the focal lengths in it.
        out: folder of the models, which should be empty.
        threads: how many.
        fixed: whether the cameras in the database are right.
        model: folder of a model that `incremental` adds images to.

    Returns:
        folders of models; none if there is no pair to begin with.

    Raises:
        DataError: the mapper ended in another way.
    """
    out.mkdir(parents=True, exist_ok=True)
    words = [method, str(database), str(out), str(threads), str(fixed), *([] if model is None else [str(model)])]
    log = out / "mapper.log"
    with log.open("w") as said:
        process = subprocess.Popen([sys.executable, "-m", __name__, *words], stdout=said, stderr=said)
        try:
            process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
    if process.returncode:
        raise DataError(f"pycolmap's {method} mapper ended with code {process.returncode}; {log} says why")
    return sorted(path for path in out.iterdir() if path.name.isdecimal())


def _map_globally(database: Path, out: Path, threads: int, fixed: bool) -> None:
    import pycolmap

    if not fixed:
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed, calibration.reestimate_relative_pose = SEED, False
        pycolmap.calibrate_view_graph(database, calibration)
    _calibrate_pairs(database, threads)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = threads, SEED
    options.mapper.bundle_adjustment.refine_focal_length = not fixed
    options.mapper.bundle_adjustment.refine_extra_params = not fixed
    pycolmap.global_mapping(database, out, out, options)


def _calibrate_pairs(database: Path, threads: int) -> None:
    """Find the essential matrix of each pair, now that focal lengths are known.

    COLMAP calls half the pairs of a hand-held video planar or panoramic, because a homography explains most of their
    matches as well, and its global mapper leaves these out: a walk falls into pieces. The rotations of their essential
    matrices are sound; translations are not used, because the mapper places cameras by points.
    """
    from concurrent.futures import ThreadPoolExecutor

    import numpy as np
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.max_H_inlier_ratio, options.min_E_F_inlier_ratio = 1.0, 0.8
    options.detect_watermark, options.compute_relative_pose = False, True
    options.ransac.random_seed = SEED
    with pycolmap.Database.open(database) as opened:
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        images = {image.image_id: image for image in opened.read_all_images()}
        points = {number: opened.read_keypoints(number)[:, :2].astype(np.float64) for number in images}
        pairs = [
            (*pycolmap.pair_id_to_image_pair(number), geometry.inlier_matches)
            for number, geometry in zip(*opened.read_two_view_geometries(), strict=True)
            if len(geometry.inlier_matches)
        ]

        def calibrate(pair: tuple) -> pycolmap.TwoViewGeometry:
            a, b, matches = pair
            ends = (cameras[images[a].camera_id], points[a], cameras[images[b].camera_id], points[b])
            return pycolmap.estimate_calibrated_two_view_geometry(*ends, matches, options)

        with ThreadPoolExecutor(threads) as pool, pycolmap.DatabaseTransaction(opened):
            for (a, b, _), geometry in zip(pairs, pool.map(calibrate, pairs), strict=True):
                opened.update_two_view_geometry(a, b, geometry)


def _map_incrementally(database: Path, out: Path, threads: int, fixed: bool, model: Path | None) -> None:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.extract_colors = threads, SEED, False
    options.multiple_models = model is None
    options.min_model_size = 3
    options.ba_refine_focal_length = options.ba_refine_extra_params = not fixed
    pycolmap.incremental_mapping(database, out, out, options, input_path=model or "")


def main() -> None:
    """Map in this process."""
    method, database, out, threads, fixed, *model = sys.argv[1:]
    places = Path(database), Path(out), int(threads), fixed == "True"
    if method == "global":
        _map_globally(*places)
    else:
        _map_incrementally(*places, Path(model[0]) if model else None)


if __name__ == "__main__":
    main()
