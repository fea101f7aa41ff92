"""The command `serve`: answers images with poses over HTTP."""

from __future__ import annotations

import os
import sys
from importlib import import_module

from lightning_pose.commands.parser import VerbParser
from lightning_pose.errors import ConfigError
from lightning_pose.localization.picture_head import MAX_PIXELS

__all__ = ["main"]

DESCRIPTION = """Answer images with poses over HTTP.

MODEL is a checkpoint that fit wrote, an MLflow run's id, a registered model such as models:/kitchen@champion, or a
folder that export wrote. POST an image to /localize; / is a page to try it, /docs lists all addresses.

The server has no encryption and asks for no password. By default only this machine's programs and browsers reach it."""

EPILOG = """examples:
  python -m lightning_pose serve mlruns/checkpoints/RUN_ID/best.ckpt
  curl --data-binary @image.jpg http://127.0.0.1:8000/localize
  curl -F image=@image.jpg -F camera=PINHOLE,640,480,525,525,319.5,239.5 http://127.0.0.1:8000/localize"""

NEEDED = {"fastapi": "fastapi", "uvicorn": "uvicorn", "python_multipart": "python-multipart"}
"""Modules of the extra `serve`, and the distributions that have them."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments after its name, until a signal ends it; return the exit code."""
    args = _build_parser().parse_args(argv)
    _check_extra()
    from lightning_pose.serving.app import create_app
    from lightning_pose.serving.limits import Limits
    from lightning_pose.serving.server import bind_socket, make_server, run_server

    limits = Limits(args.max_megabytes, args.max_pixels, args.timeout, args.threads, args.waiting)
    listener = bind_socket(args.host, args.port)  # before the model is loaded, which takes seconds
    try:
        from lightning_pose.serving.load_service import load_service

        service = load_service(args.model, args.allow)
        _use_one_core_each()
        app = create_app(service, limits, [args.host, *args.allow_host])
        host = f"[{args.host}]" if ":" in args.host else args.host
        print(f"{args.model} is served on http://{host}:{listener.getsockname()[1]}; Ctrl-C ends it", flush=True)
        run_server(make_server(app, limits.timeout_s, not args.quiet), listener)
    finally:
        listener.close()
    return 0


def _build_parser() -> VerbParser:
    parser = VerbParser("serve", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("model", metavar="MODEL", help="checkpoint, run id, model URI, or exported folder")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument("--port", type=int, default=8000, help="0 for any free one (default: %(default)s)")
    parser.add_argument("--allow-host", action="append", default=[], metavar="NAME", help="name it is called by")
    parser.add_argument("--max-megabytes", type=float, default=20.0, help="of a request (default: %(default)s)")
    parser.add_argument("--max-pixels", type=int, default=MAX_PIXELS, help="of an image (default: %(default)s)")
    parser.add_argument("--timeout", type=float, default=30.0, help="seconds to receive, and to answer (default: 30)")
    parser.add_argument("--threads", type=int, default=_count_cores(), help="images at a time (default: cores)")
    parser.add_argument("--waiting", type=int, default=64, help="requests that may wait (default: %(default)s)")
    parser.add_argument("--allow", action="append", default=[], help="class path, or package, of your own to allow")
    parser.add_argument("--quiet", action="store_true", help="no line for each request")
    return parser


def _check_extra() -> None:
    """Raise ConfigError if what serving needs is not installed."""
    missing = []
    for module, distribution in NEEDED.items():
        try:
            import_module(module)
        except ImportError:
            missing.append(distribution)
    if missing:
        raise ConfigError(
            f"serve needs {', '.join(missing)}; install the extra: uv sync --extra serve, or "
            "pip install 'lightning-camera-localization[serve]'"
        )


def _count_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _use_one_core_each() -> None:
    """Let each of the server's threads compute on one core: where more threads than cores compute, all wait."""
    import cv2

    cv2.setNumThreads(1)
    if "torch" in sys.modules:  # an exported folder does without
        import torch

        torch.set_num_threads(1)
