"""Writes the folder: network, map, facts and runner, checked against the checkpoint before it appears."""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lightning_pose import __version__
from lightning_pose.checkpoint import class_path
from lightning_pose.errors import ConfigError
from lightning_pose.export.agreement import Agreement, compare_answers, load_runner, locate_images
from lightning_pose.export.frames import CheckFrames
from lightning_pose.export.int8 import shrink_network
from lightning_pose.export.map_files import MAP_FILE, describe_keypoints, write_map
from lightning_pose.export.runner.checksums import hash_part, sign_facts
from lightning_pose.export.runner.system import FORMAT, FORMAT_VERSION
from lightning_pose.export.runner_file import write_runner
from lightning_pose.features import CNN, Pixels
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.trained_system import TrainedSystem
from lightning_pose.models import LandmarkMap
from lightning_pose.models.clip import ClipModule
from lightning_pose.models.parts.checkpoint_hooks import LEARNT_FRAMES
from lightning_pose.runs.process import is_abandoned, name_owner

__all__ = ["Exported", "export_system"]

NETWORK_FILE, RUNNER_FILE = "model.onnx", "localizer.py"

UNFINISHED = ".exporting"
"""End of the name of a folder that is being written."""

AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux's renameat2

REQUIREMENTS = """numpy>=2.1
opencv-python-headless>=5.0  # 5.0: the release tried; opencv-python and the contrib versions do as well
"""


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes:
        folder: where.
        agreement: with the checkpoint.
        int8: errors before and after, if weights have 8 bits.
        n_bytes: of each file.
    """

    folder: Path
    agreement: Agreement
    int8: Mapping[str, Any] | None
    n_bytes: Mapping[str, int]

    def describe(self) -> list[str]:
        """Lines for the user."""
        lines = [
            f"as the checkpoint on {self.agreement.images} images: at most {self.agreement.position_m:.1g} m and "
            f"{self.agreement.orientation_deg:.1g} deg apart, same status"
        ]
        if self.int8 is not None:
            (m, m_8), (deg, deg_8) = self.int8["median_m"], self.int8["median_deg"]
            lines.append(
                f"int8: median error of {self.int8['frames']} {self.int8['split']} frames {m:.4f} to {m_8:.4f} m, "
                f"{deg:.3f} to {deg_8:.3f} deg"
            )
        return lines


def export_system(
    system: TrainedSystem,
    checkpoint: Mapping[str, Any],
    frames: CheckFrames,
    out: Path,
    overwrite: bool = False,
    int8: bool = False,
) -> Exported:
    """Write a system as a folder that runs with numpy, OpenCV and onnxruntime.

    Args:
        system: of the checkpoint.
        checkpoint: what `read_checkpoint` returns.
        frames: on which the folder must answer as the system does.
        out: the folder; it appears when everything in it is written and checked.
        overwrite: replace a folder that `export` wrote.
        int8: then replace the network's weights by 8-bit ones, if its errors on frames with known poses allow it.

    Raises:
        ConfigError: the system cannot be exported, the answers differ, or `out` is there already.
    """
    out = out.expanduser().absolute()
    check_target(out, overwrite)
    out.parent.mkdir(parents=True, exist_ok=True)
    _delete_abandoned(out)
    prefix = f".{out.name}.{name_owner()}."
    with tempfile.TemporaryDirectory(prefix=prefix, suffix=UNFINISHED, dir=out.parent) as parent:
        folder = Path(parent) / out.name
        folder.mkdir()
        facts = describe_system(system, checkpoint) | write_parts(system, folder)
        (folder / RUNNER_FILE).write_text(write_runner(), encoding="utf-8")
        network = "onnxruntime>=1.18\n" if facts["network"] else ""
        (folder / "requirements.txt").write_text(REQUIREMENTS + network, encoding="utf-8")
        write_facts(folder, facts)
        agreement = check_folder(folder, system, frames)
        facts["agreement"] = asdict(agreement)
        if int8:
            if not facts["network"]:
                raise ConfigError(f"{system.name} has no network, whose weights --int8 would shrink; leave it out")
            facts["int8"] = shrink_network(folder, facts["network"], frames)
        write_facts(folder, facts)
        move_folder(folder, out)
    return Exported(out, agreement, facts["int8"], {file.name: file.stat().st_size for file in sorted(out.iterdir())})


def check_target(out: Path, overwrite: bool) -> None:
    """Refuse to write over something else than an exported folder.

    Raises:
        ConfigError: as said.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not (out / "localizer.json").is_file():
        raise ConfigError(f"{out} exists and is no exported folder; give another one")
    if not overwrite:
        raise ConfigError(f"{out} is an exported folder already; give another one, or --overwrite")


def move_folder(folder: Path, out: Path) -> None:
    """Put a finished folder in its place, in one step where the system can exchange it for an older one."""
    if out.exists():
        if _exchange(folder, out):
            return
        out.rename(folder.parent / f"{out.name}.old")
    folder.rename(out)


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two folders, so that a process that is killed leaves one or the other; False if the system cannot."""
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):  # not Linux
        return False
    return rename(AT_FDCWD, os.fsencode(a), AT_FDCWD, os.fsencode(b), RENAME_EXCHANGE) == 0


def _delete_abandoned(out: Path) -> None:
    """Delete what earlier exports to the same place have left that were killed."""
    for unfinished in out.parent.glob(f".{out.name}.*{UNFINISHED}"):
        owner = unfinished.name.removeprefix(f".{out.name}.").partition(".")[0]
        with suppress(OSError):  # another process may delete it first
            if is_abandoned(unfinished, owner):
                shutil.rmtree(unfinished)


def describe_system(system: TrainedSystem, checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """What `localizer.json` says of a system beside its parts."""
    model, frames = system.model, checkpoint.get(LEARNT_FRAMES)
    data = checkpoint["lightning_pose"]["data"]["init_args"]
    digest = None if frames is None else hashlib.blake2b(frames.numpy().tobytes(), digest_size=16).hexdigest()
    clips = None
    if isinstance(model, ClipModule) and system.clips is not None:
        length, relative_frame = system.clips
        clips = {"length": length, "relative_frame": relative_frame, "integrate": model.integrate}
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "written_by": f"lightning-camera-localization {__version__}",
        "written_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "system": system.name,
        "settings": model.headline,
        "architecture": class_path(model),
        "color": system.color,
        "clips": clips,
        "world": {"origin": model.world_frame.origin.tolist(), "scale": model.world_frame.scale},
        "ground_truth": data.get("ground_truth", "original"),
        "int8": None,
        "training_data": {"fingerprint": digest, "frames": None if frames is None else len(frames)},
    }


def write_parts(system: TrainedSystem, folder: Path) -> dict[str, Any]:
    """Write network and map; returns what `localizer.json` says of them.

    Raises:
        ConfigError: a part cannot be exported.
    """
    from lightning_pose.export.onnx_files import require_onnx, write_onnx

    model, extractor = system.model, system.extractor
    found: dict[str, Any] = {"features": {}, "network": None, "map": None}
    if not isinstance(model, LandmarkMap):
        require_onnx()
        if isinstance(extractor, CNN):
            found["features"] = {"image": True}
        elif isinstance(extractor, Pixels):
            found["features"] = {"pixels": [extractor.height, extractor.width]}
        else:
            found["features"] = {"keypoints": describe_keypoints(extractor)}
        write_onnx(model, extractor, folder / NETWORK_FILE)
        found["network"] = NETWORK_FILE
    network, refinement = model.map_network, model.refinement
    if network is not None:
        found["map"] = write_map(network, extractor if refinement is None else refinement.extractor, folder)
    if not found["network"] and not found["map"]:
        raise ConfigError(f"{system.name} has no map yet; train it first")
    return found


def write_facts(folder: Path, facts: Mapping[str, Any]) -> None:
    """Write `localizer.json`, with the checksums of the files that are there."""
    parts = [RUNNER_FILE, *(name for name in (NETWORK_FILE, MAP_FILE) if (folder / name).is_file())]
    facts = sign_facts({**facts, "files": {name: hash_part(folder / name) for name in parts}})
    (folder / "localizer.json").write_text(json.dumps(facts, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def check_folder(folder: Path, system: TrainedSystem, frames: CheckFrames) -> Agreement:
    """Compare the folder's answers, by its own runner, with the system's.

    Raises:
        ConfigError: they differ.
    """
    ours = locate_images(Localizer(system), frames.images)
    with load_runner(folder) as runner:
        theirs = locate_images(runner.Localizer.load(folder), frames.images)
    found = compare_answers(ours, theirs)
    found.check(frames.metre or system.model.world_frame.scale)
    return found
