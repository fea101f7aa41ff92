"""Requests at once to `serve`, or to `mlflow models serve`, on loopback: throughput, latency, errors and memory.

    python benchmarks/serve.py MODEL --images DIR                    MODEL: what `serve` takes
    python benchmarks/serve.py models:/NAME@ALIAS --images DIR --mlflow

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
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle, islice
from pathlib import Path

import numpy as np
import psutil

PATIENCE_S = 180


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--images", type=Path, required=True, help="folder; it is searched for .jpg and .png")
    parser.add_argument("--parallel", type=int, default=50)
    parser.add_argument("--requests", type=int, default=200)
    parser.add_argument("--threads", type=int, help="of serve")
    parser.add_argument("--mlflow", action="store_true", help="measure MLflow's server")
    args = parser.parse_args()
    files = sorted(path for path in args.images.rglob("*") if path.suffix in (".jpg", ".png"))
    images = [path.read_bytes() for path in islice(cycle(files), args.requests)]
    os.environ["MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR"] = "false"
    port = find_free_port()
    with subprocess.Popen(make_command(args, port), start_new_session=True, stdout=subprocess.DEVNULL) as process:
        try:
            started = time.perf_counter()
            wait_for_health(port)
            print(f"starts in {time.perf_counter() - started:.1f} s, {measure_megabytes(process.pid):.0f} MB")
            for parallel in (1, args.parallel):
                count = len(images) if parallel > 1 else min(len(images), 40)
                print(measure(port, images[:count], parallel, args.mlflow))
            print(f"{measure_megabytes(process.pid):.0f} MB at the end")
        finally:
            os.killpg(process.pid, signal.SIGTERM)


def find_free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def make_command(args: argparse.Namespace, port: int) -> list[str]:
    """The server's command line."""
    if args.mlflow:
        options = ["-m", args.model, "--env-manager", "local", "-p", str(port), "--timeout", "600"]
        return [sys.executable, "-m", "mlflow", "models", "serve", *options]
    threads = [] if args.threads is None else ["--threads", str(args.threads)]
    return [sys.executable, "-m", "lightning_pose", "serve", args.model, "--port", str(port), "--quiet", *threads]


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


def measure(port: int, images: list[bytes], parallel: int, mlflow: bool) -> str:
    """One line about all images, sent by so many clients."""
    started = time.perf_counter()
    with ThreadPoolExecutor(parallel) as clients:
        found = list(clients.map(lambda image: ask(port, image, mlflow), images))
    seconds = time.perf_counter() - started
    times_ms = np.array([took for _, _, took in found]) * 1000
    middle, high = np.percentile(times_ms, [50, 95])
    statuses = Counter(status for status, _, _ in found)
    accepted = sum(pose == "accepted" for _, pose, _ in found)
    return (
        f"{parallel:3} at once: {len(images) / seconds:6.1f} images/s, {middle:7.0f} ms (p50), {high:7.0f} ms (p95), "
        f"answers {dict(statuses)}, {accepted} accepted"
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
