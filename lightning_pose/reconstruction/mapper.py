"""Runs pycolmap's mappers, in a process of their own: they print, and may end the process that they run in.

`python -m lightning_pose.reconstruction.mapper METHOD DATABASE IMAGES OUT THREADS FIXED` writes models into OUT/0,
OUT/1, ... and a line `registered N` for each image that is added.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from lightning_pose.errors import DataError

__all__ = ["run_mapper"]

ERROR = "error: "


def run_mapper(
    method: str, database: Path, out: Path, threads: int, fixed_cameras: bool, on_image: Callable[[int], None] = int
) -> list[Path]:
    """Map the images of a database.

    Args:
        method: `global` (all cameras at once; Pan et al., "GLOMAP", ECCV 2024) or `incremental` (one image after the
            other; Schoenberger & Frahm, CVPR 2016).
        database: with verified pairs; `global` changes the focal lengths in it.
        out: folder of the models, which should be empty.
        threads: how many.
        fixed_cameras: whether the cameras in the database are right.
        on_image: is called with the number of images that have been registered; by `incremental` only.

    Returns:
        folders of models, in the order of their numbers; none if there is no first pair to begin with.

    Raises:
        DataError: the mapper ended in another way; the message has its last line.
    """
    out.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", __name__, method, str(database), str(out), str(threads), "0", str(fixed_cameras)]
    log = out / "mapper.log"
    with log.open("w") as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            assert process.stdout is not None
            for line in process.stdout:
                if line.startswith("registered "):
                    on_image(int(line.split()[1]))
        except BaseException:
            process.kill()
            raise
        finally:
            process.wait()
    if process.returncode:
        raise DataError(f"pycolmap's {method} mapper ended with code {process.returncode}; {log} says why")
    return sorted((path for path in out.iterdir() if path.name.isdecimal()), key=lambda path: int(path.name))


def _map_global(database: Path, out: Path, threads: int, seed: int, fixed: bool) -> None:
    import pycolmap

    if not fixed:
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = seed
        pycolmap.calibrate_view_graph(database, calibration)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = threads, seed
    options.mapper.bundle_adjustment.refine_focal_length = not fixed
    options.mapper.bundle_adjustment.refine_extra_params = not fixed
    pycolmap.global_mapping(database, out, out, options)


def _map_incrementally(database: Path, out: Path, threads: int, seed: int, fixed: bool) -> None:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.extract_colors = threads, seed, False
    options.min_model_size = 3
    options.ba_refine_focal_length = options.ba_refine_extra_params = not fixed
    count = 0

    def report() -> None:
        nonlocal count
        count += 1
        print(f"registered {count}", flush=True)

    pycolmap.incremental_mapping(database, out, out, options, next_image_callback=report)


def main() -> None:
    """Map in this process."""
    method, database, out, threads, seed, fixed = sys.argv[1:]
    run = _map_global if method == "global" else _map_incrementally
    run(Path(database), Path(out), int(threads), int(seed), fixed == "True")


if __name__ == "__main__":
    main()
