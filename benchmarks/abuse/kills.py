"""`kill -9` at random moments of `fit`, `extract`, `export` and `reconstruct`; the same command then goes on."""

from __future__ import annotations

import random
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import psutil
import torch
from mlflow import MlflowClient

from benchmarks.abuse.signals import list_torn
from benchmarks.abuse.table import Row
from benchmarks.abuse.workplace import Workplace
from lightning_pose.features.record_files import read_record
from tests.processes import ForkedProcess

__all__ = ["GOOD", "kill_commands", "kill_fits", "read_result", "resume_fit"]

GOOD = ("same as uninterrupted", "begun anew", "had ended")

Result = Mapping[str, object]


def kill_fits(base: Workplace, times: int | None) -> Iterator[Row]:
    """Kill `fit` of four systems, resume each run, and compare it with the uninterrupted one; a row each.

    Args:
        base: a workplace.
        times: how often each, 30 by default.
    """
    for system in filter(base.wants, ("SurfLSTM", "CNNRNN", "NodePose", "LandmarkMap")):
        words = ("fit", "--config", base.config(system))
        assert base.run(*words).code == 0
        seconds, place = _measure_seconds(base, words)
        expected = read_result(place)
        rng, found = random.Random(0), Counter[str]()  # noqa: S311
        for _ in range(30 if times is None else times):
            found[_kill_fit(base, words, rng.uniform(0, seconds), expected)] += 1
        yield _make_row(f"kill -9 of `fit` of {system}, then `--ckpt_path last`", found)


def _measure_seconds(base: Workplace, words: Sequence[object]) -> tuple[float, Workplace]:
    """Processor time of a command that is not killed, and where it ran."""
    place = base.copy()
    with place.fork(*words) as process:
        seconds = _watch(process, float("inf"))
        assert process.wait() == 0
    return seconds, place


def _watch(process: ForkedProcess, most: float) -> float:
    """Wait until a process has used so much processor time or has ended; the time it has used."""
    used = 0.0
    with suppress(psutil.NoSuchProcess):
        watched = psutil.Process(process.pid)
        while process.poll() is None and used < most:
            times = watched.cpu_times()
            used = times.user + times.system
            time.sleep(0.002)
    return used


def read_result(place: Workplace) -> Result:
    """Weights of the newest run of a workplace, and all that it has logged but costs."""
    run = place.runs()[0]
    found: dict[str, object] = {"status": run.info.status}
    found |= {name: value for name, value in run.data.metrics.items() if not name.startswith("cost/")}
    for name in ("best", "last"):
        weights = torch.load(place.checkpoint(run, name), weights_only=True)["state_dict"]
        found |= {f"{name}.{key}": value.numpy().tobytes() for key, value in weights.items()}
    client = MlflowClient(place.uri)
    for name in run.data.metrics:
        if not name.startswith("cost/"):
            history = client.get_metric_history(run.info.run_id, name)
            found[f"{name} by step"] = sorted((metric.step, metric.value) for metric in history)
    return found


def _kill_fit(base: Workplace, words: Sequence[object], seconds: float, expected: Result) -> str:
    """Kill a run after so much processor time, let it go on, and compare."""
    place = base.copy()
    with place.fork(*words) as process:
        _watch(process, seconds)
        process.kill()
        ended = process.wait() == 0
    return resume_fit(place, words, ended, expected)


def resume_fit(place: Workplace, words: Sequence[object], ended: bool, expected: Result) -> str:
    """Let a run go on that was killed, unless it `ended`, and compare it with the uninterrupted one."""
    resumed = place.complete(*words, "--ckpt_path", "last")
    anew = resumed.code == 2 and "no run of" in resumed.stderr
    if anew:
        resumed = place.complete(*words)
    runs = place.runs()
    if resumed.code == 2 and "raise --trainer.max_epochs" in resumed.stderr and runs[0].info.status == "FINISHED":
        ended = True
    elif resumed.code != 0:
        return f"cannot go on: {resumed.stderr.strip().splitlines()[-1][:100]}"
    result = read_result(place)
    if result != expected:
        names = sorted(name for name in result.keys() | expected.keys() if result.get(name) != expected.get(name))
        return f"differs from the uninterrupted run in {', '.join(names[:3])} ({len(names)})"
    if any(run.info.status == "RUNNING" for run in runs):
        return "run left RUNNING"
    if len(runs) > 1 + anew:
        return "another MLflow run"
    if list_torn(place.folder):
        return "file left over"
    return "had ended" if ended else "begun anew" if anew else "same as uninterrupted"


def kill_commands(base: Workplace, times: int | None) -> Iterator[Row]:
    """Kill `extract`, `export` and `reconstruct`; a row each.

    Args:
        base: a workplace.
        times: how often each, 30 by default.
    """
    count = 30 if times is None else times
    config = base.config("refined")
    assert base.run("fit", "--config", config).code == 0
    best = base.checkpoint(base.runs()[0], "best")
    records: dict[str, bytes] = {}  # of the command that is not killed

    def check_cache(place: Workplace) -> bool:
        found = _read_records(place.folder / "cache")
        records.update({} if records else found)
        return found == records

    def check_folder(place: Workplace) -> bool:
        return place.complete("localize", "exported", base.room / "seq-01" / "frame-000000.color.png").code in (0, 1)

    def check_scene(place: Workplace) -> bool:
        return place.complete("check", "scene").code == 0

    if base.wants("extract"):
        yield _kill_command(base, ("extract", "--config", config), 2, count, check_cache, ())
    if base.wants("export"):
        yield _kill_command(base, ("export", best, "--out", "exported"), 1, count, check_folder, ("--overwrite",))
    images = base.folder / "images"
    images.mkdir()
    for image in sorted((base.room / "seq-01").glob("*.png")):
        shutil.copy(image, images)
    if base.wants("reconstruct"):
        yield _kill_command(base, ("reconstruct", images, "scene"), 1, count, check_scene, ())


def _read_records(cache: Path) -> Mapping[str, bytes]:
    """The arrays of all records of a feature cache, by their names; their order in a file is not always the same."""
    found: dict[str, bytes] = {}
    for file in cache.rglob("??/*.safetensors"):
        record = read_record(file) or {}
        found[file.name] = b"".join(name.encode() + record[name].tobytes() for name in sorted(record))
    return found


def _kill_command(
    base: Workplace,
    words: Sequence[object],
    processes: int,
    count: int,
    check: Callable[[Workplace], bool],
    again: Sequence[str],
) -> Row:
    """Kill several processes of one command at once, run it again, and check what it has written."""
    place = base.copy(features=words[0] != "extract")
    with place.fork(*words) as process:
        seconds = _watch(process, float("inf"))
        assert process.wait() == 0
    assert check(place)
    rng, found = random.Random(0), Counter[str]()  # noqa: S311
    for _ in range(count):
        place = base.copy(features=words[0] != "extract")
        started = [place.fork(*words) for _ in range(processes)]
        _watch(started[0], rng.uniform(0, seconds / processes))
        for process in started:
            process.kill()
        ended = sum(process.wait() == 0 for process in started) == processes
        out = place.folder / str(words[-1])
        whole = not out.is_dir() or words[0] != "export" or check(place)
        code = place.complete(*words, *(again if out.is_dir() else ())).code
        if not whole:
            found["half a folder"] += 1
        elif code != 0:
            found[f"exit code {code} afterwards"] += 1
        elif not check(place):
            found["wrong result"] += 1
        elif list_torn(place.folder):
            found["file left over"] += 1
        else:
            found["had ended" if ended else "same as uninterrupted"] += 1
    many = f" in {processes} processes" if processes > 1 else ""
    return _make_row(f"kill -9 of `{words[0]}`{many}, then the same again", found)


def _make_row(what: str, found: Counter[str]) -> Row:
    bad = {kind: number for kind, number in found.items() if kind not in GOOD}
    return Row(what, found.total(), bad, ", ".join(f"{found[kind]} {kind}" for kind in GOOD if found[kind]))
