"""The page in a real browser: a picture is dropped, or chosen, and the answer appears in the map."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pytest

from lightning_pose.errors import ConfigError
from lightning_pose.localization.located_pose import LocatedPose
from lightning_pose.serving.map_view import view_from_above
from lightning_pose.serving.service import Json, Service
from lightning_pose.serving.uploads import Upload
from tests import browser
from tests.serving.helpers import encode_picture, serve

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.skipif(browser.chromium() is None, reason="there is no Chromium on this machine")

DROP = """(drop, [name, content]) => {
    const bytes = Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0));
    const data = new DataTransfer();
    data.items.add(new File([bytes], name, {type: "image/png"}));
    for (const kind of ["dragover", "drop"])
        drop.dispatchEvent(new DragEvent(kind, {dataTransfer: data, bubbles: true, cancelable: true}));
}"""


def locate(upload: Upload) -> Json:
    """Answers that the file's name asks for; a camera is refused."""
    if upload.camera:
        raise ConfigError(f"camera {upload.camera!r}: no camera model")
    refused = {"status": "refused", "reason": "too few matches"} if "refused" in str(upload.name) else {}
    return LocatedPose(
        np.array([2.0, 1.5, -1.0]),
        np.array([1.0, 0, 0, 0]),
        **{"radius_m": 0.25, "radius_deg": 1.0, "source": "map", "inliers": 40, "visible": 90, **refused},
        milliseconds={"total": 12.0},
        image=upload.name,
    ).to_dict()


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """The page of a room of 4 by 4 units, seen by cameras in a row that look along z with y down."""
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0, 0], [4, 2, 4], (300, 3))
    position = np.stack([np.linspace(1, 3, 9), np.ones(9), np.full(9, 0.5)], axis=1)
    model = {"architecture": "LandmarkMap", "scene": "<b>room</b>", "version": "0"}
    service = Service(locate, model, view_from_above(points, np.tile(np.eye(3), (9, 1, 1)), position))
    with serve(service) as server, browser.open_page(server.address, width=1100, height=800) as opened:
        messages: list[str] = []
        opened.on("console", lambda message: messages.append(message.text))
        opened.on("pageerror", lambda error: messages.append(str(error)))
        opened.goto(server.address)
        opened.locator("#map .camera").wait_for(state="attached")
        yield opened
        assert [text for text in messages if "422" not in text] == []  # no script failed, nothing was blocked


def drop(page: Page, name: str) -> None:
    page.locator("#drop").evaluate(DROP, [name, base64.b64encode(encode_picture()).decode()])


def status(page: Page, text: str) -> None:
    page.locator("#status").filter(has_text=text).wait_for()


def test_a_dropped_picture_appears_in_the_map(page: Page) -> None:
    assert page.locator("#map .answer").count() == 0
    drop(page, "hall.png")
    status(page, "accepted")
    place = page.locator("#map g.accepted")
    # x is to the right; y is down, so that z is up on the page
    assert [float(place.get_attribute(name) or "") for name in ("data-x", "data-y")] == pytest.approx([2.0, -1.0])
    assert "2.000, 1.500, -1.000" in page.locator("#answer").inner_text()
    assert "40 of 90 visible points" in page.locator("#answer").inner_text()
    frame, radius = page.locator("#map").bounding_box(), page.locator("#map .radius").bounding_box()
    assert frame is not None
    assert radius is not None
    assert frame["x"] < radius["x"] < frame["x"] + frame["width"]  # an answer outside the map is in the drawing too
    assert frame["y"] < radius["y"] + radius["height"] < frame["y"] + frame["height"]
    arrow = page.locator("#map .answer").bounding_box()
    assert arrow is not None
    tip, centre = arrow["y"], radius["y"] + radius["height"] / 2
    assert centre - tip > arrow["y"] + arrow["height"] - centre  # it looks along z
    assert page.locator("#preview").evaluate("image => image.complete && image.naturalWidth") == 64


def test_a_chosen_picture_and_a_refused_one(page: Page) -> None:
    page.locator("#file").set_input_files({"name": "refused.png", "mimeType": "image/png", "buffer": encode_picture()})
    status(page, "refused: too few matches")
    assert page.locator("#map g.refused .answer").count() == 1
    assert page.locator("#map g.accepted").count() == 0


def test_errors_are_shown_as_text(page: Page) -> None:
    page.locator("summary").first.click()
    page.locator("#camera").fill("<img src=x onerror=alert(1)>")
    drop(page, "a.png")
    status(page, "camera '<img src=x onerror=alert(1)>': no camera model")
    page.locator("#camera").fill("")
    assert page.locator("#map .answer").count() == 0
    assert page.locator("main img").count() == 1
    assert "<b>room</b>" in page.locator("#model").inner_text()


def test_the_page_for_programs_is_read(page: Page) -> None:
    page.get_by_role("link", name="Addresses for programs").click()
    page.get_by_role("heading", name="POST /localize").wait_for()
    page.go_back()
