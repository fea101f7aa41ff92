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
        calibration.random_seed = SEED
        pycolmap.calibrate_view_graph(database, calibration)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = threads, SEED
    options.mapper.bundle_adjustment.refine_focal_length = not fixed
    options.mapper.bundle_adjustment.refine_extra_params = not fixed
    pycolmap.global_mapping(database, out, out, options)


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
