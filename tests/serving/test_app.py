"""The addresses: what is answered, every kind of bad request, limits, and many requests at once."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from lightning_pose.errors import ConfigError, ImageError
from lightning_pose.serving.service import Json, Service
from lightning_pose.serving.uploads import Upload
from tests.serving.helpers import Answer, Server, encode_picture, locate_nowhere, make_form, make_png, serve

PICTURE = encode_picture()


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serve(max_megabytes=0.1, max_pixels=1_000_000, hosts=("robot",)) as running:
        yield running


@pytest.mark.parametrize("kind", [".png", ".jpg", ".webp", ".bmp", ".tiff", ".ppm"])
def test_an_image_as_the_body_or_in_a_form(kind: str, server: Server) -> None:
    image = encode_picture(kind)
    for answer in (server.post(image, name="a/b.png"), server.post_form(image, "b.png")):
        assert answer.status == 200, answer.body
        assert answer.json["image"] == "b.png"
        assert answer.json["status"] == "accepted"
        assert answer.json["radius_m"] is None


def test_settings_come_from_the_form_or_the_query() -> None:
    seen: list[Upload] = []

    def locate(upload: Upload) -> Json:
        seen.append(upload)
        return locate_nowhere(upload)

    with serve(Service(locate, {})) as server:
        server.post(PICTURE, camera="PINHOLE,1,2", prior="0,0,0")
        server.post_form(PICTURE, camera="PINHOLE,1,2", prior="0,0,0")
        server.post(PICTURE)
    assert [upload[2:] for upload in seen] == [("PINHOLE,1,2", "0,0,0")] * 2 + [(None, None)]
    assert all(upload.image == PICTURE for upload in seen)


@pytest.mark.parametrize("name", ["../../etc/passwd", "..\\..\\secret.png", "/etc/passwd", "%2e%2e%2fpasswd", "a\0b"])
def test_a_file_name_is_only_a_name(name: str, server: Server) -> None:
    answer = server.post(PICTURE, name=name)
    assert answer.status == 200
    assert not set("/\\\0") & set(answer.json["image"])


@pytest.mark.parametrize(
    "path",
    [
        "/../app.py",
        "/static/page.js",
        "/page.js/../../app.py",
        "/%2e%2e/app.py",
        "/..%2f..%2fetc/passwd",
        "//etc/passwd",
    ],
)
def test_no_other_file_is_sent(path: str, server: Server) -> None:
    assert server.ask("GET", path).code == "not_found"


def test_health_model_and_no_map(server: Server) -> None:
    assert server.ask("GET", "/health").json == {"status": "ok", "requests": 0, "threads": 2}
    assert server.ask("GET", "/model").json == {"architecture": "StandIn"}
    assert server.ask("GET", "/map").code == "no_map"
    assert server.ask("GET", "/localize").code == "method"
    assert server.ask("GET", "/nowhere").code == "not_found"


def test_the_api_is_described_without_another_server(server: Server) -> None:
    spec = server.ask("GET", "/openapi.json").json
    assert set(spec["paths"]) == {"/health", "/model", "/map", "/localize"}
    operation = spec["paths"]["/localize"]["post"]
    assert set(operation["requestBody"]["content"]) == {"multipart/form-data", "image/*"}
    assert {"413", "415", "422", "503", "504"} <= set(operation["responses"])
    described = operation["responses"]["200"]["content"]["application/json"]["schema"]["properties"]
    assert described.keys() == server.post(PICTURE).json.keys()
    page = server.ask("GET", "/docs").body.decode()
    assert "POST /localize" in page
    for text in ("http://", "https://", "<script"):
        assert text not in page


BAD_REQUESTS = {
    "text": (b"hello, I am no image", 415, "not_an_image"),
    "web page": (b"<!doctype html><html></html>", 415, "not_an_image"),
    "json": (b'{"image": "/etc/passwd"}', 415, "not_an_image"),
    "path": (b"/etc/passwd", 415, "not_an_image"),
    "gif": (b"GIF89a" + bytes(100), 415, "not_an_image"),
    "svg": (b"<svg xmlns='http://www.w3.org/2000/svg'/>", 415, "not_an_image"),
    "only a signature": (b"\x89PNG\r\n\x1a\n", 415, "not_an_image"),
    "nothing": (b"", 400, "no_image"),
    "too many bytes": (bytes(200_000), 413, "too_large"),
    "too many pixels": (make_png(2000, 501, b""), 413, "too_many_pixels"),
    "a bomb's head": (make_png(60_000, 60_000, b""), 413, "too_many_pixels"),
    "a bomb": (make_png(30_000, 30_000, bytes(10_000_000)), 413, "too_many_pixels"),
}


@pytest.mark.parametrize("name", BAD_REQUESTS)
def test_bad_bodies(name: str, server: Server) -> None:
    body, status, code = BAD_REQUESTS[name]
    for answer in (server.post(body), server.post_form(body)):
        assert (answer.status, answer.code) == (status, code)
        assert answer.headers["content-type"] == "application/json"
        assert "Traceback" not in answer.body.decode()


BAD_FORMS = {
    "no boundary": (b"--edge", "multipart/form-data", "malformed"),
    "another boundary": (make_form(PICTURE)[0], "multipart/form-data; boundary=other", "malformed"),
    "no form": (b"hello", "multipart/form-data; boundary=edge", "malformed"),
    "cut short": (make_form(PICTURE)[0][:80], "multipart/form-data; boundary=edge", "no_image"),
    "another field": (make_form(PICTURE)[0].replace(b'"image"', b'"other"'), make_form(PICTURE)[1], "no_image"),
    "not a file": (
        b'--edge\r\nContent-Disposition: form-data; name="image"\r\n\r\n/etc/passwd\r\n--edge--\r\n',
        "multipart/form-data; boundary=edge",
        "no_image",
    ),
    "two files": (
        make_form(PICTURE)[0][: -len("--edge--\r\n")] + make_form(PICTURE)[0],
        "multipart/form-data; boundary=edge",
        "malformed",
    ),
    "long field": (make_form(PICTURE, camera="x" * 50_000)[0], "multipart/form-data; boundary=edge", "malformed"),
}


@pytest.mark.parametrize("name", BAD_FORMS)
def test_bad_forms(name: str, server: Server) -> None:
    body, kind, code = BAD_FORMS[name]
    answer = server.ask("POST", "/localize", body, {"Content-Type": kind})
    assert (answer.status, answer.code) == (400, code)


@pytest.mark.parametrize("error", [ImageError("the image is truncated"), ConfigError("camera 'x' is no camera")])
def test_what_the_localizer_refuses_is_unusable(error: Exception) -> None:
    def locate(upload: Upload) -> Json:
        raise error

    with serve(Service(locate, {})) as server:
        answer = server.post(PICTURE)
    assert (answer.status, answer.code) == (422, "unusable")
    assert answer.json["error"]["message"] == str(error)


def test_a_mistake_in_the_program_stays_on_the_server(capfd: pytest.CaptureFixture[str]) -> None:
    def locate(upload: Upload) -> Json:
        raise ZeroDivisionError("secret /home/me/model.ckpt")

    with serve(Service(locate, {})) as server:
        answer = server.post(PICTURE)
        assert (answer.status, answer.code) == (500, "internal")
        assert server.ask("GET", "/health").json["requests"] == 0
    assert b"secret" not in answer.body


def test_a_body_that_grows_is_cut_off(server: Server) -> None:
    """Without a content length, in chunks."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        head = b"POST /localize HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
        connection.sendall(head + b"".join(b"4e20\r\n" + bytes(20_000) + b"\r\n" for _ in range(20)) + b"0\r\n\r\n")
        assert b"413" in connection.recv(1000).split(b"\r\n")[0]


@pytest.mark.parametrize(
    "head", [b"Content-Length: 50000\r\n", b"Transfer-Encoding: chunked\r\n"], ids=["length", "chunks"]
)
def test_a_slow_body_is_refused(head: bytes) -> None:
    with serve(timeout_s=0.5) as server, socket.create_connection(("127.0.0.1", server.port), timeout=20) as slow:
        slow.sendall(b"POST /localize HTTP/1.1\r\nHost: localhost\r\n" + head + b"\r\n")
        started, received = time.monotonic(), b""
        while piece := slow.recv(10_000):  # until the server ends the connection
            received += piece
        assert time.monotonic() - started < 10
        assert b" 408 " in received.split(b"\r\n")[0]
        assert json.loads(received.split(b"\r\n\r\n")[1])["error"]["code"] == "slow"
        assert server.ask("GET", "/health").json["requests"] == 0


def test_a_head_that_never_ends_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lightning_pose.serving.server.HEADERS_S", 0.5)
    with serve() as server, socket.create_connection(("127.0.0.1", server.port), timeout=20) as slow:
        started = time.monotonic()
        slow.sendall(b"POST /localize HTTP/1.1\r\nHost:")
        assert slow.recv(1000) == b""
        assert time.monotonic() - started < 10


@pytest.mark.parametrize(
    "head", [b"Content-Length: -5\r\n", b"Content-Length: 5\r\nContent-Length: 6\r\n", b"no colon\r\n"]
)
def test_what_is_no_http_is_refused(head: bytes, server: Server) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        connection.sendall(b"POST /localize HTTP/1.1\r\nHost: localhost\r\n" + head + b"\r\nhello")
        assert b" 400 " in connection.recv(1000).split(b"\r\n")[0]


def test_a_client_that_leaves_is_forgotten(server: Server) -> None:
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as connection:
        connection.sendall(b"POST /localize HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5000\r\n\r\nhello")
        time.sleep(0.2)
    deadline = time.monotonic() + 10
    while server.ask("GET", "/health").json["requests"]:
        assert time.monotonic() < deadline
        time.sleep(0.02)


class Gate:
    """A localizer that answers once it is opened."""

    def __init__(self) -> None:
        self.opened = threading.Event()

    def __call__(self, upload: Upload) -> Json:
        assert self.opened.wait(30)
        return locate_nowhere(upload)


def ask_at_once(server: Server, count: int) -> list[Answer]:
    with ThreadPoolExecutor(count) as threads:
        return list(threads.map(lambda _: server.post(PICTURE), range(count)))


def test_fifty_requests_at_once(server: Server) -> None:
    answers = ask_at_once(server, 50)
    assert [answer.status for answer in answers] == [200] * 50
    assert server.ask("GET", "/health").json["requests"] == 0


def test_more_than_may_wait_are_refused_with_a_time() -> None:
    gate = Gate()
    with serve(Service(gate, {}), threads=1, waiting=2) as server, ThreadPoolExecutor(3) as threads:
        taken = [threads.submit(server.post, PICTURE) for _ in range(3)]
        while server.ask("GET", "/health").json["requests"] < 3:
            time.sleep(0.02)
        refused = server.post(PICTURE)
        assert (refused.status, refused.code, refused.headers["retry-after"]) == (503, "busy", "1")
        gate.opened.set()
        assert [future.result().status for future in taken] == [200] * 3


def test_a_long_answer_is_given_up_and_counts_until_it_is_done() -> None:
    gate = Gate()
    with serve(Service(gate, {}), threads=1, waiting=1, timeout_s=0.5) as server, ThreadPoolExecutor(2) as threads:
        first = threads.submit(server.post, PICTURE)
        while not server.ask("GET", "/health").json["requests"]:
            time.sleep(0.01)
        second = threads.submit(server.post, PICTURE)
        assert (first.result().status, first.result().code) == (504, "timeout")
        assert (second.result().status, second.result().code) == (503, "busy")  # no thread became free
        assert server.ask("GET", "/health").json["requests"] == 1
        gate.opened.set()
        while server.ask("GET", "/health").json["requests"]:
            time.sleep(0.01)
        assert server.post(PICTURE).status == 200


def test_other_origins_and_names_are_refused(server: Server) -> None:
    own, others = server.address, ("http://evil.example", "null", "https://127.0.0.1:1", "http://127.0.0.1")
    assert server.ask("POST", "/localize", PICTURE, {"Origin": own}).status == 200
    for origin in others:
        assert server.ask("POST", "/localize", PICTURE, {"Origin": origin}).code == "origin"
    for host in ("localhost", "localhost:8000", "127.0.0.1:1", "[::1]:80", "192.168.0.7", "robot", "Robot:80"):
        assert server.ask("GET", "/health", headers={"Host": host}).status == 200
    for host in ("evil.example", "evil.example:8000", "", "127.0.0.1.evil.example", "[::1", "localhost.evil.example"):
        answer = server.ask("GET", "/health", headers={"Host": host})
        assert answer.code == "host", host
    answer = server.ask("GET", "/health")
    assert "access-control-allow-origin" not in answer.headers
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["content-security-policy"].startswith("default-src 'none'")
