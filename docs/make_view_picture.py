"""The picture of docs/localize.md: a recording of `localize --view` in rerun's web viewer, in a headless Chromium.

    python -m docs.make_view_picture docs/pictures/view.png FILE.rrd

Run it from the repository. The viewer draws with WebGL, which Chromium does in software where there is no GPU.
"""

from __future__ import annotations

import argparse
import shutil
import socket
import subprocess
import urllib.parse
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from tests import browser

GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
WIDTH, HEIGHT = 1280, 760

PANELS = ((1200, 18), (1256, 18))
"""Where the viewer has the switches of its left and its right panel: the page is one canvas, without elements."""

STARTED_MS, DRAWN_MS = 6_000, 90_000
"""The canvas does not say when it is drawn."""


def find_free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def take_picture(rrd: Path, picture: Path) -> None:
    """Show a recording, and write what is to be seen as PNG."""
    page_port, data_port = find_free_port(), find_free_port()
    rerun = shutil.which("rerun")
    assert rerun is not None, "uv sync --extra view"
    ports = ("--web-viewer-port", str(page_port), "--port", str(data_port))
    server = subprocess.Popen([rerun, str(rrd), "--serve-web", "--bind", "127.0.0.1", *ports])
    try:
        with sync_playwright() as playwright:
            chromium = playwright.chromium.launch(executable_path=browser.chromium(), args=["--no-sandbox", *GL])
            page = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            page.wait_for_timeout(STARTED_MS)
            data = urllib.parse.quote(f"rerun+http://127.0.0.1:{data_port}/proxy", safe="")
            page.goto(f"http://127.0.0.1:{page_port}/?renderer=webgl&url={data}")
            page.wait_for_timeout(DRAWN_MS)
            for place in PANELS:
                page.mouse.click(*place)
                page.wait_for_timeout(STARTED_MS)
            page.mouse.move(WIDTH // 2, HEIGHT - 10)
            page.wait_for_timeout(STARTED_MS)
            page.screenshot(path=picture, timeout=60_000)
            chromium.close()
    finally:
        server.terminate()
        server.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("recording", type=Path)
    args = parser.parse_args()
    take_picture(args.recording, args.picture)
    Image.open(args.picture).convert("RGB").quantize(256).save(args.picture, optimize=True)
    print(args.picture)


if __name__ == "__main__":
    main()
