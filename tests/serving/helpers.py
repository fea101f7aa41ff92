"""A server on loopback with a stand-in for the localizer, and requests to it."""

from __future__ import annotations

import http.client
import json
import struct
import threading
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple
from urllib.parse import quote

import cv2
import numpy as np

from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.serving.app import create_app
from lightning_pose.serving.limits import Limits
from lightning_pose.serving.server import bind_socket, make_server
from lightning_pose.serving.service import Json, Service
from lightning_pose.serving.uploads import Upload

__all__ = ["Answer", "Server", "encode_picture", "locate_nowhere", "make_form", "make_png", "serve"]


class Answer(NamedTuple):
    """A response: status, headers in lower case, and the body."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def code(self) -> str:
        """The code of an error, which has the one shape."""
        error = self.json["error"]
        assert error.keys() == {"status", "code", "message"}
        assert error["status"] == self.status
        return error["code"]


class Server(NamedTuple):
    """A running server on loopback."""

    port: int

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def ask(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        headers: Mapping[str, str] | None = None,
        **query: str,
    ) -> Answer:
        """One request on a connection of its own."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        text = "&".join(f"{name}={quote(value)}" for name, value in query.items())
        connection.request(method, f"{path}?{text}" if text else path, body, dict(headers or {}))
        response = connection.getresponse()
        answer = Answer(response.status, {k.lower(): v for k, v in response.getheaders()}, response.read())
        connection.close()
        return answer

    def post(self, body: bytes, **query: str) -> Answer:
        """Send an image as the whole body."""
        return self.ask("POST", "/localize", body, {"Content-Type": "application/octet-stream"}, **query)

    def post_form(self, image: bytes, name: str = "a.png", **fields: str) -> Answer:
        """Send an image as a file of a form."""
        body, kind = make_form(image, name, **fields)
        return self.ask("POST", "/localize", body, {"Content-Type": kind})


def locate_nowhere(upload: Upload) -> Json:
    """A stand-in for a localizer."""
    return LocatedPose(np.zeros(3), np.array([1.0, 0, 0, 0]), image=upload.name).to_dict()


@contextmanager
def serve(service: Service | None = None, hosts: tuple[str, ...] = (), **limits: Any) -> Iterator[Server]:
    """A server that ends with the block."""
    service = service or Service(locate_nowhere, {"architecture": "StandIn"})
    chosen = Limits(**{"threads": 2, "timeout_s": 20.0, **limits})
    server = make_server(create_app(service, chosen, hosts), chosen.timeout_s)
    listener = bind_socket("127.0.0.1", 0)
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    try:
        deadline = time.monotonic() + 30
        while not server.started:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        yield Server(listener.getsockname()[1])
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def encode_picture(kind: str = ".png", size: tuple[int, int] = (64, 48)) -> bytes:
    """The bytes of an image file, width by height."""
    pixels = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    return cv2.imencode(kind, pixels)[1].tobytes()


def make_form(image: bytes, name: str = "a.png", **fields: str) -> tuple[bytes, str]:
    """A form with a file, and its content type."""
    parts = [f'--edge\r\nContent-Disposition: form-data; name="{k}"\r\n\r\n{v}\r\n'.encode() for k, v in fields.items()]
    head = f'--edge\r\nContent-Disposition: form-data; name="image"; filename="{name}"\r\n\r\n'.encode()
    return b"".join([*parts, head, image, b"\r\n--edge--\r\n"]), "multipart/form-data; boundary=edge"


def make_png(width: int, height: int, rows: bytes) -> bytes:
    """A gray PNG whose head and data need not agree."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")
