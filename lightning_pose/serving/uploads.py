"""Reads a request's image and settings from its body, within the limits of size and time."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from pathlib import PurePosixPath
from typing import NamedTuple

from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.types import Message

from lightning_pose.serving.errors import RequestError, too_large
from lightning_pose.serving.limits import Limits

__all__ = ["RequestBody", "Upload"]

MAX_FIELD_BYTES = 16_384
"""Of the fields beside the image."""

DROP_S = 2.0
"""How long the rest of a refused body is read: a client that is cut off while it sends does not read the answer."""

FORM = "multipart/form-data"


class Upload(NamedTuple):
    """What a request holds.

    Attributes:
        image: bytes of an image file.
        name: the file's name, without folders; None where it is not given.
        camera: text, as `Camera.parse` reads it; None where it is not given.
        prior: text of a pose; None where it is not given.
    """

    image: bytes
    name: str | None = None
    camera: str | None = None
    prior: str | None = None


class RequestBody:
    """The body of a request, of which no more than the limit is kept.

    Args:
        request: not read yet.
        limits: size and time.

    Attributes:
        complete: whether all of it has been received.
    """

    def __init__(self, request: Request, limits: Limits) -> None:
        self.limits = limits
        self.complete = False
        self._request = request
        self._received = 0

    async def read_upload(self) -> Upload:
        """Read a form with a file in the field `image`, or the image as the whole body.

        Settings come from fields of the form, or from the query. Nothing is read from the server's disk.

        Raises:
            RequestError: the body is too large, too slow, malformed, or has no image.
        """
        headers, limits = self._request.headers, self.limits
        declared = headers.get("content-length", "")
        if declared.isdigit() and int(declared) > limits.max_bytes:
            raise too_large(limits.max_megabytes)
        limited = Request(self._request.scope, self._receive)
        try:
            async with asyncio.timeout(limits.timeout_s):
                if headers.get("content-type", "").partition(";")[0].strip().lower() == FORM:
                    return await _read_form(limited)
                return _read_query(await limited.body(), limited)
        except TimeoutError:
            raise RequestError(408, "slow", f"the request was not received within {limits.timeout_s:g} s") from None
        except ClientDisconnect:
            raise RequestError(400, "cut_off", "the connection ended before the request did") from None

    async def drop(self) -> None:
        """Read what the client still sends, for a short time, so that it gets to read the error."""
        if "expect" in self._request.headers:
            return  # it waits for the answer before it sends
        with suppress(TimeoutError):
            async with asyncio.timeout(DROP_S):
                while not self.complete:
                    self._note(await self._request.receive())

    async def _receive(self) -> Message:
        message = await self._request.receive()
        self._note(message)
        self._received += len(message.get("body", b""))
        if self._received > self.limits.max_bytes:
            raise too_large(self.limits.max_megabytes)
        return message

    def _note(self, message: Message) -> None:
        self.complete = not message.get("more_body", False)


def _read_query(image: bytes, request: Request) -> Upload:
    """The image as the whole body, and settings in the query."""
    if not image:
        raise RequestError(400, "no_image", "the request is empty; send an image as its body, or as the field image")
    camera, prior, name = (request.query_params.get(field) or None for field in ("camera", "prior", "name"))
    return Upload(image, _clean_name(name), camera, prior)


async def _read_form(request: Request) -> Upload:
    """The image as a file of a form, and settings in its fields or in the query."""
    try:
        form = await request.form(max_files=1, max_fields=8, max_part_size=MAX_FIELD_BYTES)
    except HTTPException as error:
        raise RequestError(400, "malformed", f"the form cannot be read ({error.detail})") from error
    except (ValueError, KeyError) as error:  # of the parser: a malformed part, or no boundary
        raise RequestError(400, "malformed", f"the form cannot be read ({error}); let a library write it") from error
    image = form.get("image")
    if not isinstance(image, UploadFile):
        raise RequestError(400, "no_image", "the form has no file in its field image; give one, with a file name")
    data = await image.read()
    await form.close()
    if not data:
        raise RequestError(400, "no_image", "the file in the field image is empty")
    fields = (form.get(name) or request.query_params.get(name) for name in ("camera", "prior"))
    camera, prior = (field if isinstance(field, str) and field else None for field in fields)
    return Upload(data, _clean_name(image.filename), camera, prior)


def _clean_name(name: str | None) -> str | None:
    """The last part of a client's file name, of at most 200 characters that can be printed."""
    last = PurePosixPath((name or "").replace("\\", "/")).name
    return "".join(letter for letter in last if letter.isprintable())[:200] or None
