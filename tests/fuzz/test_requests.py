"""Damaged HTTP requests to the server: an answer, or an error in its one shape, and the server goes on."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lightning_pose.serving.load_service import load_service
from tests.fuzz.datasets import WORDS, Damage, apply_damages, damages
from tests.serving.helpers import Server, encode_picture, make_form, serve

CHECKPOINT = Path(__file__).parents[1] / "checkpoint" / "files" / "surf_lstm_0_1.ckpt"
FORM, FORM_TYPE = make_form(encode_picture(), camera="PINHOLE,64,48,60,60,31.5,23.5", prior="0 0 0 1 0 0 0")
BODIES = [(encode_picture(".jpg"), "application/octet-stream"), (encode_picture(), "image/png"), (FORM, FORM_TYPE)]
PATHS = [
    "/localize",
    "/localize?camera=PINHOLE,64,48,60,60,31.5,23.5",
    "/health",
    "/model",
    "/map",
    "/",
    "/docs",
    "/no",
]
TYPES = ["", "text/plain", "multipart/form-data", "multipart/form-data; boundary=", "application/json", "\xff"]
HEADERS = ["Origin", "Host", "Content-Encoding", "Transfer-Encoding", "Expect", "Content-Length", "Cookie", "X-Real-Ip"]

WORST_STATUS = 499


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serve(load_service(str(CHECKPOINT), []), timeout_s=20.0) as server:
        yield server


def send(server: Server, data: bytes) -> bytes:
    """Everything that the server answers to these bytes."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=30) as connection:
        answer = b""
        try:
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
            while part := connection.recv(65536):
                answer += part
        except ConnectionError:  # the server closes on what it does not take
            pass
        return answer


headers = st.lists(st.tuples(st.sampled_from(HEADERS), st.sampled_from(WORDS)), max_size=2)


@given(
    method=st.sampled_from(["POST", "POST", "POST", "GET", "PUT", "DELETE", "HEAD", "OPTIONS", "X"]),
    path=st.sampled_from(PATHS),
    query=st.lists(st.tuples(st.sampled_from(["camera", "prior", "name", "x"]), st.sampled_from(WORDS)), max_size=2),
    body=st.sampled_from(BODIES),
    kind=st.none() | st.sampled_from(TYPES),
    extra=headers,
    damaged=st.lists(damages, max_size=1),
    whole=st.booleans(),
)
def test_damaged_request(
    method: str,
    path: str,
    query: list[tuple[str, str]],
    body: tuple[bytes, str],
    kind: str | None,
    extra: list[tuple[str, str]],
    damaged: list[list[Damage]],
    whole: bool,
    server: Server,
) -> None:
    """Its body, or the whole request with its head."""
    content = body[0]
    if damaged and not whole:
        content = apply_damages({"a": content}, damaged[0]).get("a", b"")
    path += "".join(f"{'&' if '?' in path or i else '?'}{name}={word}" for i, (name, word) in enumerate(query))
    fields = {"Host": "localhost", "Content-Type": body[1] if kind is None else kind, "Content-Length": len(content)}
    fields |= dict(extra)
    head = f"{method} {path} HTTP/1.1\r\n" + "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    request = head.encode("utf-8", "replace") + b"Connection: close\r\n\r\n" + content
    if damaged and whole:
        request = apply_damages({"a": request}, damaged[0]).get("a", b"")
    answer = send(server, request)
    if answer:
        head, _, content = answer.partition(b"\r\n\r\n")
        version, status = head.split()[:2]
        assert version == b"HTTP/1.1"
        assert int(status) <= WORST_STATUS, answer[:500]
        if int(status) >= 400 and content.startswith(b"{"):
            assert set(json.loads(content)["error"]) == {"status", "code", "message"}
    assert server.ask("GET", "/health").status == 200
