"""The command `serve` in a process of its own: answers, signals, exit codes, and mistakes."""

from __future__ import annotations

import http.client
import signal
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from lightning_pose.localization.localizer import Localizer
from tests.helpers import Trained
from tests.processes import ForkedProcess
from tests.serving.helpers import Server


@contextmanager
def started(trained: Trained, *options: object) -> Iterator[tuple[ForkedProcess, Server]]:
    """The command on a free port, once it answers."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        server = Server(free.getsockname()[1])
    words = ("serve", trained.best, "--allow", "tests", "--port", server.port, *options)
    with trained.workplace.fork(*words) as process:
        deadline = time.monotonic() + 100
        while True:
            with suppress(OSError):
                if server.ask("GET", "/health").status == 200:
                    break
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.1)
        yield process, server


def test_it_answers_as_the_localizer_until_it_is_ended(trained: Trained, scene: Path) -> None:
    image = next((scene / "seq-03").glob("*.png"))
    with started(trained) as (process, server):
        answer = server.post_form(image.read_bytes(), image.name)
        expected = Localizer.load(trained.best, allow="tests").localize(image)
        assert answer.json["image"] == image.name
        np.testing.assert_allclose(answer.json["position_m"], expected.position_m)
        np.testing.assert_allclose(answer.json["quat_wxyz"], expected.quat_wxyz)
        model = server.ask("GET", "/model").json
        assert (model["architecture"], model["scene"], model["features"]) == ("SurfLSTM", "wall", "Thumbnails")
        assert str(trained.workplace.folder) not in str(model)
        assert server.post(image.read_bytes(), camera="PINHOLE,64,48,50,50,32,24").code == "unusable"  # it has no map
        assert server.post(b"\x89PNG broken").code == "not_an_image"
        cut = server.post(image.read_bytes()[: image.stat().st_size // 2])
        assert (cut.status, cut.code) == (422, "unusable")
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate()
    assert process.returncode == 130
    assert f"is served on http://127.0.0.1:{server.port}; Ctrl-C ends it" in stdout
    assert '"POST /localize HTTP/1.1" 200' in stdout
    assert "Traceback" not in stderr


def test_sigterm_waits_for_requests_that_have_begun(trained: Trained, scene: Path) -> None:
    image = next((scene / "seq-03").glob("*.png")).read_bytes()
    with started(trained, "--quiet") as (process, server):
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        connection.putrequest("POST", "/localize")
        connection.putheader("Content-Length", str(len(image)))
        connection.endheaders(image[:100])
        while server.ask("GET", "/health").json["requests"] == 0:
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        time.sleep(0.5)
        with pytest.raises(OSError, match="refused"):
            server.ask("GET", "/health")  # no new ones
        connection.send(image[100:])
        assert connection.getresponse().status == 200
        connection.close()
        _, stderr = process.communicate()
    assert process.returncode == 143
    assert "Traceback" not in stderr


def run(trained: Trained, capsys: pytest.CaptureFixture[str], *options: object) -> str:
    """The one line of a command that is refused."""
    assert trained.workplace.command("serve", *options, allow=()) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    return line


def test_mistakes_are_one_line(trained: Trained, capsys: pytest.CaptureFixture[str]) -> None:
    best = trained.best
    assert "the following arguments are required: MODEL" in run(trained, capsys)
    assert "nowhere.ckpt" in run(trained, capsys, "nowhere.ckpt", "--port", "0")
    assert "--allow tests.helpers.Thumbnails" in run(trained, capsys, best, "--port", "0")
    assert "--port is 70000; give 0 to 65535" in run(trained, capsys, best, "--port", "70000")
    assert "--threads is 0; give more than 0" in run(trained, capsys, best, "--threads", "0")
    assert "--max-megabytes is nan" in run(trained, capsys, best, "--max-megabytes", "nan")
    assert "--waiting is -1; give 0 or more" in run(trained, capsys, best, "--waiting", "-1")
    assert "--host 256.1.1.1 --port 0 cannot be used" in run(
        trained, capsys, best, "--host", "256.1.1.1", "--port", "0"
    )
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"--port {port} cannot be used (Address already in use)" in run(trained, capsys, best, "--port", port)


def test_without_the_extra_it_says_what_to_install(
    trained: Trained, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "fastapi", None)
    monkeypatch.setitem(sys.modules, "python_multipart", None)
    line = run(trained, capsys, trained.best)
    assert "serve needs fastapi, python-multipart; install the extra: uv sync --extra serve" in line
