"""The server's addresses: an image in, a pose out; what runs here; and a page to try it."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from functools import partial
from importlib.resources import files

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response
from starlette.exceptions import HTTPException

from lightning_pose import __version__
from lightning_pose.errors import PoseError
from lightning_pose.localization.picture_head import NotAnImageError, TooManyPixelsError, check_head
from lightning_pose.serving.api_page import render_api_page
from lightning_pose.serving.errors import RequestError, error_response
from lightning_pose.serving.guards import Guard
from lightning_pose.serving.limits import Limits
from lightning_pose.serving.schemas import LOCALIZE, describe_answer
from lightning_pose.serving.service import Json, Service
from lightning_pose.serving.uploads import RequestBody, Upload
from lightning_pose.serving.workers import WorkerPool

__all__ = ["create_app"]

STATIC = {"page.html": "text/html", "page.js": "text/javascript", "page.css": "text/css", "icon.svg": "image/svg+xml"}


def create_app(service: Service, limits: Limits, hosts: Iterable[str] = ()) -> FastAPI:
    """Build the application.

    Args:
        service: what answers.
        limits: of requests.
        hosts: names that the server is called by, beside `localhost` and addresses.
    """
    pool = WorkerPool(limits)

    @asynccontextmanager
    async def close_at_the_end(_: FastAPI) -> AsyncIterator[None]:
        yield
        pool.close()

    app = FastAPI(
        title="lightning_pose",
        summary="An image in, the camera's pose out.",
        version=__version__,
        docs_url=None,  # FastAPI's pages load scripts from another server
        redoc_url=None,
        lifespan=close_at_the_end,
    )
    app.add_middleware(Guard, hosts=hosts)
    app.add_exception_handler(RequestError, _answer_error)
    app.add_exception_handler(HTTPException, _answer_error)
    app.add_exception_handler(Exception, _answer_error)
    _add_static_pages(app)

    @app.get("/health", summary="Whether the server answers", responses=describe_answer("health"))
    async def health() -> JSONResponse:
        return JSONResponse({"status": "ok", "requests": pool.busy, "threads": limits.threads})

    @app.get("/model", summary="What runs here", responses=describe_answer("model"))
    async def model() -> JSONResponse:
        return JSONResponse(service.model)

    @app.get("/map", summary="The map from above, for the page", responses=describe_answer("map"))
    async def view() -> JSONResponse:
        if service.view is None:
            raise RequestError(404, "no_map", "this system has no map")
        return JSONResponse(service.view)

    @app.post("/localize", summary="Locate one image", responses=describe_answer("pose"), openapi_extra=LOCALIZE)
    async def localize(request: Request) -> JSONResponse:
        """Where the image was taken: 200 for a pose, refused ones too (`status` says which)."""
        body = RequestBody(request, limits)
        try:
            with pool.admit():
                upload = await body.read_upload()
                return JSONResponse(await pool.run(partial(_locate, service, upload, limits)))
        except RequestError as error:
            await _end_body(body, error)
            raise

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(render_api_page(app.openapi()))

    return app


def _locate(service: Service, upload: Upload, limits: Limits) -> Json:
    """The pose of an upload, on a thread of the pool."""
    try:
        check_head(upload.image, limits.max_pixels)
        return service.locate(upload)
    except TooManyPixelsError as error:
        raise RequestError(413, "too_many_pixels", str(error)) from error
    except NotAnImageError as error:
        raise RequestError(415, "not_an_image", str(error)) from error
    except PoseError as error:
        raise RequestError(422, "unusable", str(error)) from error


async def _end_body(body: RequestBody, error: RequestError) -> None:
    """Receive the rest of a refused request, or say that the connection ends."""
    if not body.complete and error.status != 408:
        await body.drop()
    if not body.complete:
        error.headers["Connection"] = "close"


async def _answer_error(_: Request, error: Exception) -> JSONResponse:
    """Any error in the one shape; what a mistake in this program says stays on the server."""
    if isinstance(error, HTTPException):
        code = {404: "not_found", 405: "method"}.get(error.status_code, "refused")
        wrapped = RequestError(error.status_code, code, f"{error.detail}; /docs lists what there is")
        wrapped.headers.update(error.headers or {})
        error = wrapped
    if not isinstance(error, RequestError):
        error = RequestError(500, "internal", "the server failed on this request; its log says why")
    return error_response(error)


def _add_static_pages(app: FastAPI) -> None:
    """The page and its files, each at an address of its own, so that no other file can be asked for."""
    for name, kind in STATIC.items():
        content = files("lightning_pose.serving").joinpath("static", name).read_bytes()
        address = "/" if name == "page.html" else f"/{name}"
        app.get(address, include_in_schema=False)(partial(_send_file, content, kind))


async def _send_file(content: bytes, kind: str) -> Response:
    return Response(content, media_type=kind)
