"""RequestError: why a request gets no pose. All errors have one shape in JSON."""

from __future__ import annotations

from fastapi.responses import JSONResponse

__all__ = ["RequestError", "busy", "error_response", "too_large"]

RETRY_AFTER_S = 1


class RequestError(Exception):
    """A request that is answered with an error.

    Args:
        status: of HTTP.
        code: one word for programs, which stays the same between versions.
        message: names the value and the remedy.

    Attributes:
        headers: of the answer.
    """

    def __init__(self, status: int, code: str, message: str) -> None:
        super().__init__(message)
        self.status = status
        self.code = code
        self.message = message
        self.headers: dict[str, str] = {}


def too_large(max_megabytes: float) -> RequestError:
    """The error of a body above the limit."""
    message = f"the request has more than {max_megabytes:g} MB; send a smaller or more compressed image"
    return RequestError(413, "too_large", message)


def busy(message: str) -> RequestError:
    """The error of a server that has too much to do; it says when to try again."""
    error = RequestError(503, "busy", message)
    error.headers["Retry-After"] = str(RETRY_AFTER_S)
    return error


def error_response(error: RequestError) -> JSONResponse:
    """`{"error": {"status": 413, "code": "too_large", "message": "..."}}`."""
    content = {"status": error.status, "code": error.code, "message": error.message}
    return JSONResponse({"error": content}, error.status, error.headers)
