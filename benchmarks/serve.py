"""Requests at once to `serve`, or to `mlflow models serve`, on loopback: throughput, latency, errors and memory.

    python -m benchmarks.serve MODEL --images DIR                    MODEL: what `serve` takes
    python -m benchmarks.serve models:/NAME@ALIAS --images DIR --mlflow

Each of `--parallel` clients sends one image after the other, each on a connection of its own.
"""

from __future__ import annotations

import argparse
import base64
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from benchmarks.measurement import ROOT, Goal, Measurement, Options, time_process

PATIENCE_S = 180
PARALLEL = 50
AT_LEAST = 1
"""Our server should answer no fewer images than MLflow's."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--images", type=Path, required=True, help="folder; it is searched for .jpg and .png")
    parser.add_argument("--parallel", type=int, default=PARALLEL)
    parser.add_argument("--requests", type=int, default=200)
    parser.add_argument("--threads", type=int, help="of serve")
    parser.add_argument("--mlflow", action="store_true", help="measure MLflow's server")
    args = parser.parse_args()
    images = list_images(args.images, args.requests)
    command = make_mlflow_command(args.model) if args.mlflow else make_command(args.model, args.threads)
    started = time.perf_counter()
    with serving(command, Path.cwd()) as (port, process):
        print(f"starts in {time.perf_counter() - started:.1f} s, {measure_megabytes(process):.0f} MB")
        for parallel in (1, args.parallel):
            count = len(images) if parallel > 1 else min(len(images), 40)
            print(send_images(port, images[:count], parallel, args.mlflow).text)
        print(f"{measure_megabytes(process):.0f} MB at the end")


def measure(options: Options) -> Iterator[Measurement]:
    """A row of requests at once, of a landmark map of a synthetic room."""
    os.environ["MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR"] = "false"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        variables = {"LIGHTNING_POSE_CACHE": str(folder / "cache"), "MLFLOW_TRACKING_URI": f"sqlite:///{folder}/m.db"}
        program = [sys.executable, "-m", "lightning_pose"]
        config = ROOT / "configs" / "landmark_map.yaml"
        time_process([*program, "synth", "room"], folder, variables)
        time_process([*program, "fit", "--config", str(config), "--data.root", "room"], folder, variables)
        (checkpoint,) = folder.glob("mlruns/checkpoints/*/best.ckpt")
        commands = {
            False: make_command(str(checkpoint)),
            True: make_mlflow_command(f"runs:/{checkpoint.parent.name}/model"),
        }
        found: dict[bool, Sent] = {}
        for mlflow, command in commands.items():
            images = list_images(folder / "room", 50 if mlflow else 200)
            with serving(command, folder, variables) as (port, _):
                send_images(port, images[:4], 1, mlflow)
                found[mlflow] = send_images(port, images, PARALLEL, mlflow)
            print(found[mlflow].text, file=sys.stderr, flush=True)
    ours, theirs = found[False].per_second, found[True].per_second
    what, peer = f"`serve`, {PARALLEL} requests of 320x240 at once", "`mlflow models serve`"
    yield Measurement(what, ours, peer, theirs, ours / theirs, Goal("ratio", AT_LEAST, at_least=True), unit="images/s")


def list_images(folder: Path, count: int) -> list[bytes]:
    """The images below a folder, so many, again and again where there are fewer."""
    files = sorted(path for path in folder.rglob("*") if path.suffix in (".jpg", ".png") and "depth" not in path.name)
    return [path.read_bytes() for path in islice(cycle(files), count)]


@contextmanager
def serving(
    command: list[str], folder: Path, environment: Mapping[str, str] | None = None
) -> Iterator[tuple[int, int]]:
    """Start a server and wait until it answers; its port and process number."""
    port = find_free_port()
    paths = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    variables = {**os.environ, "PYTHONPATH": paths, **(environment or {})}
    words = [word.format(port=port) for word in command]
    with subprocess.Popen(
        words, cwd=folder, env=variables, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            wait_for_health(port)
            yield port, process.pid
        finally:
            os.killpg(process.pid, signal.SIGTERM)


def find_free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def make_command(model: str, threads: int | None = None) -> list[str]:
    """Our server's command line."""
    words = [sys.executable, "-m", "lightning_pose", "serve", model, "--port", "{port}", "--quiet"]
    return words if threads is None else [*words, "--threads", str(threads)]


def make_mlflow_command(model: str) -> list[str]:
    """The command line of MLflow's server."""
    options = ["-m", model, "--env-manager", "local", "-p", "{port}", "--timeout", "600"]
    return [sys.executable, "-m", "mlflow", "models", "serve", *options]


def wait_for_health(port: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        try:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
            connection.request("GET", "/health")
            if connection.getresponse().status == 200:
                return
        except OSError:
            time.sleep(0.1)
    raise SystemExit(f"the server does not answer within {PATIENCE_S} s")


class Sent(NamedTuple):
    """Images that a server answers in a second, and a line about them."""

    per_second: float
    text: str


def send_images(port: int, images: list[bytes], parallel: int, mlflow: bool) -> Sent:
    """Send all images, by so many clients."""
    started = time.perf_counter()
    with ThreadPoolExecutor(parallel) as clients:
        found = list(clients.map(lambda image: ask(port, image, mlflow), images))
    seconds = time.perf_counter() - started
    times_ms = np.array([took for _, _, took in found]) * 1000
    middle, high = np.percentile(times_ms, [50, 95])
    statuses = Counter(status for status, _, _ in found)
    accepted = sum(pose == "accepted" for _, pose, _ in found)
    return Sent(
        len(images) / seconds,
        f"{parallel:3} at once: {len(images) / seconds:6.1f} images/s, {middle:7.0f} ms (p50), {high:7.0f} ms (p95), "
        f"answers {dict(statuses)}, {accepted} accepted",
    )


def ask(port: int, image: bytes, mlflow: bool) -> tuple[int, str, float]:
    """Status of the answer and of the pose, and seconds."""
    started = time.perf_counter()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=600)
    if mlflow:
        content = json.dumps({"dataframe_records": [{"image": base64.b64encode(image).decode()}]})
        connection.request("POST", "/invocations", content, {"Content-Type": "application/json"})
    else:
        connection.request("POST", "/localize", image, {"Content-Type": "application/octet-stream"})
    response = connection.getresponse()
    answer = json.loads(response.read())
    connection.close()
    pose = answer["predictions"][0] if mlflow and "predictions" in answer else answer
    return response.status, pose.get("status", ""), time.perf_counter() - started


def measure_megabytes(pid: int) -> float:
    """Resident memory of a process and those that it has started."""
    process = psutil.Process(pid)
    return sum(each.memory_info().rss for each in [process, *process.children(recursive=True)]) / 1e6


if __name__ == "__main__":
    main()
