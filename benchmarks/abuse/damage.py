"""Bytes flipped and files cut short: a cache record, checkpoints, and every file of an exported folder."""

from __future__ import annotations

import contextlib
import io
import random
import signal
import struct
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch

from benchmarks.abuse.table import Row
from benchmarks.abuse.workplace import Workplace
from lightning_pose.checkpoint import read_checkpoint
from lightning_pose.errors import PoseError
from lightning_pose.export.agreement import load_runner
from lightning_pose.features import SURF
from lightning_pose.features.cache import FeatureCache
from lightning_pose.localization.localizer import Localizer
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.runs.checkpoint_files import CheckpointFiles
from lightning_pose.scenes.images import read_rgb

__all__ = ["damage_exported", "damage_records"]

STEP = 1000
"""A file is cut at every so many bytes."""

HEADER = 1000
"""Bytes at the beginning of a file whose header has no length of its own."""

MOST_SECONDS = 20
"""An answer that takes longer has hung."""


class HungError(Exception):
    """No answer in `MOST_SECONDS`."""


@dataclass(frozen=True)
class Target:
    """A file to damage.

    Attributes:
        name: in the table.
        file: the file.
        ask: an answer that depends on the file, as plain numbers.
        header: how many bytes are flipped one by one, from the beginning.
        tail: the same from the end.
        random: how many bytes elsewhere are flipped.
    """

    name: str
    file: Path
    ask: Callable[[], Any]
    header: int
    tail: int = 0
    random: int = 1000


def damage_records(base: Workplace, times: int | None) -> Iterator[Row]:
    """Damage a cache record and checkpoints; a row each.

    Args:
        base: a workplace.
        times: how many bytes of the body are flipped, 1000 by default.
    """
    for target in _list_records(base):
        yield _damage(target, target.random if times is None else times)


def damage_exported(base: Workplace, times: int | None) -> Iterator[Row]:
    """Damage every file of an exported folder that is read; a row each.

    Args:
        base: a workplace.
        times: how many bytes of the body are flipped, 1000 by default, and 300 of `localizer.py`.
    """
    assert base.run("fit", "--config", base.config("refined")).code == 0
    folder = base.folder / "exported"
    assert base.run("export", base.checkpoint(base.runs()[0], "best"), "--out", folder).code == 0
    for target in _list_exported(folder, min(base.room.glob("seq-*/*.png"))):
        yield _damage(target, target.random if times is None else min(times, target.random))


def _list_records(base: Workplace) -> Iterator[Target]:
    images = sorted(base.room.glob("seq-*/*.png"))
    cache = FeatureCache(SURF(50), base.folder / "records")
    cache.fill(images[:1], 1, progress=False)
    (record,) = cache.root.rglob("??/*.safetensors")
    yield Target(
        "cache record", record, lambda: cache.features(images[:1], 1, False).tobytes(), _read_header_size(record)
    )
    for system, name in (("SurfLSTM", "last"), ("LandmarkMap", "best")):
        assert base.run("fit", "--config", base.config(system)).code == 0
        yield _make_checkpoint_target(f"{name}.ckpt of {system}", base.checkpoint(base.runs()[0], name), images[0])


def _make_checkpoint_target(name: str, file: Path, image: Path) -> Target:
    def ask() -> Any:
        checkpoint = read_checkpoint(file)
        CheckpointFiles().load_checkpoint(file, weights_only=True)
        return _plain(checkpoint), _plain_pose(Localizer.load(file).localize(image))

    with zipfile.ZipFile(file) as archive:
        # The entry that says what the file holds comes first, and the archive's list of entries last.
        return Target(name, file, ask, HEADER, file.stat().st_size - archive.start_dir)


def _list_exported(folder: Path, image: Path) -> Iterator[Target]:
    mirrored = np.ascontiguousarray(read_rgb(image)[:, ::-1])  # the map refuses it, so that the network answers

    def ask() -> Any:
        return [_plain_pose(pose) for pose in Localizer.load(folder).localize([image, mirrored])]

    def ask_runner() -> Any:
        hidden = contextlib.redirect_stderr(io.StringIO())
        with load_runner(folder) as module, contextlib.redirect_stdout(io.StringIO()) as out, hidden:
            code = module.main(folder, [str(image)])
            if code == 2:
                raise PoseError
            return out.getvalue().partition('"milliseconds"')[0]

    facts = folder / "localizer.json"
    yield Target("exported localizer.json", facts, ask, facts.stat().st_size, random=0)
    yield Target(
        "exported map.safetensors", folder / "map.safetensors", ask, _read_header_size(folder / "map.safetensors")
    )
    yield Target("exported model.onnx", folder / "model.onnx", ask, HEADER)
    yield Target("exported localizer.py", folder / "localizer.py", ask_runner, 0, random=300)


def _read_header_size(file: Path) -> int:
    """The length of a safetensors file's header."""
    return 8 + struct.unpack("<Q", file.read_bytes()[:8])[0]


def _plain(value: Any) -> Any:
    """Nested values with arrays as bytes, so that equal ones compare as equal."""
    if isinstance(value, torch.Tensor):
        return value.numpy().tobytes()
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list | tuple) else value


def _plain_pose(pose: LocatedPose) -> Any:
    numbers = np.concatenate([pose.position_m, pose.quat_wxyz, [pose.radius_m, pose.radius_deg]])
    return numbers.tobytes(), pose.status, pose.reason, pose.source


def _damage(target: Target, count: int) -> Row:
    """Damage one file in all ways, and restore it."""
    whole, rng = target.file.read_bytes(), random.Random(0)  # noqa: S311
    expected, size = target.ask(), len(whole)
    ends = [*range(min(target.header, size)), *range(max(target.header, size - target.tail), size)]
    places = [*ends, *(rng.randrange(size) for _ in range(count))]
    damaged = [whole[:at] + bytes([whole[at] ^ rng.randrange(1, 256)]) + whole[at + 1 :] for at in places]
    damaged += [whole[:length] for length in range(0, size, STEP)]
    found: Counter[str] = Counter()
    try:
        for data in damaged:
            target.file.write_bytes(data)
            found[_judge(target.ask, expected, target.file.suffix == ".py")] += 1
    finally:
        target.file.write_bytes(whole)
    bad = {kind: number for kind, number in found.items() if kind not in ("refused", "no effect")}
    what = f"{target.name}: {len(places)} bytes flipped, cut {len(damaged) - len(places)} times"
    return Row(what, len(damaged), bad, f"{found['refused']} refused, {found['no effect']} right answers")


def _judge(ask: Callable[[], Any], expected: Any, runs_code: bool) -> str:
    """What came of asking a damaged file."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise HungError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(MOST_SECONDS)
    try:
        return "no effect" if ask() == expected else "WRONG ANSWER"
    except PoseError:
        return "refused"
    except HungError:
        return "hangs"
    except (SyntaxError, NameError, AttributeError) as error:
        return "refused" if runs_code else f"traceback ({type(error).__name__})"  # by Python: localizer.py is code
    except (Exception, SystemExit) as error:
        return f"traceback ({type(error).__name__})"
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
