"""The picture of docs/serve.md: the server's page after an image was chosen, in a headless Chromium.

    python -m docs.make_serve_page docs/serve_page.png CHECKPOINT IMAGE

Run it from the repository; the checkpoint and the image are those of a synthetic room.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

from lightning_pose.serving.load_service import load_service
from tests import browser
from tests.serving.helpers import serve


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("image", type=Path)
    args = parser.parse_args()
    service = load_service(args.checkpoint)
    with serve(service) as server, browser.open_page(server.address, width=1100, height=740) as page:
        page.goto(server.address)
        page.locator("#map .camera").wait_for(state="attached")
        page.locator("#file").set_input_files(args.image)
        page.locator("#map .answer").wait_for(state="attached")
        page.screenshot(path=args.picture)
    Image.open(args.picture).convert("RGB").quantize(96).save(args.picture, optimize=True)  # a third of the size
    print(args.picture)


if __name__ == "__main__":
    main()
