"""What requests and answers look like, for the OpenAPI page."""

from __future__ import annotations

from typing import Any

__all__ = ["LOCALIZE", "POSE", "describe_answer"]

Schema = dict[str, Any]


def _object(properties: Schema, **others: object) -> Schema:
    return {"type": "object", "properties": properties, **others}


def _list(items: Schema, length: int | None = None) -> Schema:
    bounds = {} if length is None else {"minItems": length, "maxItems": length}
    return {"type": "array", "items": items, **bounds}


def _text(description: str, *values: str) -> Schema:
    return {"type": "string", "description": description, **({"enum": list(values)} if values else {})}


def _optional(kind: str, description: str) -> Schema:
    return {"type": [kind, "null"], "description": description}


NUMBER: Schema = {"type": "number"}
MATRIX = "(6, 6): x, y, z in the scene's unit, then rotations about the world's axes in rad; null if unknown"

POSE = _object(
    {
        "image": _optional("string", "the file's name, if it was sent"),
        "status": _text("whether the pose can be used", "accepted", "refused"),
        "reason": _text("why it is refused; empty if it is accepted"),
        "source": _text("what the pose comes from", "map", "network", "nearest"),
        "position_m": {**_list(NUMBER, 3), "description": "the camera's centre, in the scene's unit"},
        "quat_wxyz": {**_list(NUMBER, 4), "description": "camera-to-world, OpenCV axes"},
        "T_world_cam": {**_list(_list(NUMBER, 4), 4), "description": "camera-to-world, row by row"},
        "radius_m": _optional("number", "holds 90 % of position errors; null if unknown or refused"),
        "radius_deg": _optional("number", "the same of orientation errors"),
        "covariance": {"type": ["array", "null"], "items": _list(NUMBER, 6), "description": MATRIX},
        "inliers": _optional("integer", "matches of the map within 3 pixels; null without a map"),
        "visible": _optional("integer", "points of the map that the image should show; null without a map"),
        "milliseconds": _object({}, additionalProperties=NUMBER, description="by stage, and total"),
        "time_s": _optional("number", "of a video's frame; null for an image"),
        "notes": {**_list({"type": "string"}), "description": "what was done to the image"},
    }
)
"""`LocatedPose.to_dict()`."""

ERROR = _object(
    {
        "error": _object(
            {
                "status": {"type": "integer", "description": "of HTTP"},
                "code": _text("one word for programs"),
                "message": _text("names the value and the remedy"),
            }
        )
    }
)

ANSWERS: dict[str, tuple[str, Schema]] = {
    "pose": ("the pose, or the best guess with `status` refused", POSE),
    "health": ("the server answers", _object({"status": _text("ok"), "requests": {"type": "integer"}})),
    "model": ("architecture, camera, ground truth, version, scene", _object({})),
    "map": ("points and training cameras in a plane", _object({})),
}

ERRORS = {
    400: "no image, or a malformed request",
    403: "asked by another name or from a page of another origin",
    408: "the request came too slowly",
    413: "too many bytes or pixels",
    415: "the bytes are no image",
    422: "the image is damaged, or the camera or prior is not understood",
    503: "busy; Retry-After says when to try again",
    504: "locating took too long",
}

CAMERA = _text(
    "MODEL,WIDTH,HEIGHT,PARAMETERS... as COLMAP has it, such as PINHOLE,640,480,525,525,319.5,239.5; that of the "
    "training images if not given"
)
PRIOR = _text("a pose to start from: x,y,z,qw,qx,qy,qz")

IMAGE: Schema = {"type": "string", "format": "binary", "description": "JPEG, PNG, WebP, TIFF, BMP or PPM"}

LOCALIZE: Schema = {
    "parameters": [
        {"name": name, "in": "query", "required": False, "schema": schema, "description": schema["description"]}
        for name, schema in (
            ("camera", CAMERA),
            ("prior", PRIOR),
            ("name", _text("file name of an image that is the whole body")),
        )
    ],
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": _object({"image": IMAGE, "camera": CAMERA, "prior": PRIOR}, required=["image"])
            },
            "image/*": {"schema": IMAGE},
        },
    },
}
"""The request of `POST /localize`, which FastAPI cannot read from its signature."""


def describe_answer(name: str) -> dict[int | str, Schema]:
    """The answers of an address, with every error that it may have.

    Args:
        name: one of `ANSWERS`.
    """
    description, schema = ANSWERS[name]
    errors = ERRORS if name == "pose" else {403: ERRORS[403], **({404: "there is no map"} if name == "map" else {})}
    content = {"application/json": {"schema": ERROR}}
    return {
        200: {"description": description, "content": {"application/json": {"schema": schema}}},
        **{status: {"description": text, "content": content} for status, text in errors.items()},
    }
