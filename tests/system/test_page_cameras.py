"""Cameras on the page: pictures with detections, contours, and things."""

import asyncio
from collections.abc import AsyncIterator

import cv2
import numpy as np
import pytest
import pytest_asyncio
from playwright.async_api import Page

from gigabrain_schemas.objects import Detection, Detections
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import DETECTIONS, IMAGE
from gigabrain_zenoh.testing.waiting import until
from tests.system.fake_page import Fake, serving
from tests.system.page import VIEWER, Browser, browser, needs_browser
from tests.system.test_page_map import drawn

pytestmark = [needs_browser, pytest.mark.asyncio(loop_scope="module")]

LIGHT = "document.documentElement.dataset.theme = 'light'"
PIXELS = """([camera, at]) => {
  const canvas = document.querySelectorAll(`#pictures [data-camera="${camera}"] canvas`)[at]
  return [...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data]
}"""


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def fake(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Fake]:
    fake = Fake(tmp_path_factory.mktemp("fake"))
    async with serving(fake):
        yield fake


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def started(fake: Fake, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Browser]:
    async with browser(fake, tmp_path_factory.mktemp("profile")) as chromium:
        yield chromium


@pytest_asyncio.fixture(loop_scope="module")
async def chromium(started: Browser) -> AsyncIterator[Browser]:
    yield started
    await started.close_pages()


def jpeg(value: int = 200, *, end: int | None = None) -> Image:
    """Return a grey JPEG of 32 x 16 pixels, cut off after `end` bytes if it is set."""
    data = cv2.imencode(".jpg", np.full((16, 32, 3), value, np.uint8))[1].tobytes()
    return Image(frame_id="front", encoding="jpeg", width=32, height=16, data=data[:end])


async def shown(fake: Fake, page: Page, camera: str, picture: Image, values: list[int]) -> None:
    """Publish a picture repeatedly until the page shows these values as its first pixels."""
    for _ in range(300):
        fake.robot.publish(IMAGE, picture, name=camera)
        await asyncio.sleep(0.1)
        if await page.query_selector(f'#pictures [data-camera="{camera}"] canvas'):
            pixels = await page.evaluate(PIXELS, [camera, 0])
            if pixels[: len(values)] == values:
                return
    raise AssertionError(f"{camera} shows {pixels[: len(values)]}")


async def test_pictures_of_cameras_are_drawn(chromium: Browser, fake: Fake) -> None:
    page = await chromium.open()
    await page.wait_for_selector(
        "#show-cameras[aria-pressed=true]"
    )  # open by default on a wide page
    grey = Image(frame_id="cam", encoding="mono8", height=1, width=2, data=b"\x00\xff")
    rgb = Image(frame_id="cam", encoding="rgb8", height=1, width=1, data=b"\x0a\x14\x1e")
    await shown(fake, page, "front", grey, [0, 0, 0, 255, 255, 255, 255, 255])
    await shown(fake, page, "left", rgb, [10, 20, 30, 255])
    await shown(fake, page, "front", jpeg(), [200, 200, 200, 255])
    names = await page.locator("#pictures figcaption").all_inner_texts()
    assert names == ["front", "left", "rear"]


async def test_the_problem_of_a_camera_is_shown(chromium: Browser) -> None:
    page = await chromium.open()
    await page.wait_for_selector('#pictures [data-camera="rear"] [role=status]:has-text("covered")')


async def test_a_broken_picture_is_reported_and_the_next_one_shown(
    chromium: Browser, fake: Fake
) -> None:
    page = await chromium.open()
    figure = '#pictures [data-camera="front"]'
    await shown(fake, page, "front", jpeg(100), [100, 100, 100, 255])
    bomb = bytearray(jpeg().data)
    at = bomb.index(b"\xff\xc0")
    bomb[at + 5 : at + 9] = b"\xff\xdc\xff\xdc"
    bomb_image = Image(frame_id="front", encoding="jpeg", width=32, height=16, data=bytes(bomb))
    for _ in range(100):
        fake.robot.publish(IMAGE, bomb_image, name="front")
        await asyncio.sleep(0.1)
        if "65500 x 65500" in await page.inner_text(figure):
            break
    assert "a JPEG of 65500 x 65500 pixels" in await page.inner_text(figure)
    fake.robot.publish(IMAGE, jpeg(end=300), name="front")
    await shown(fake, page, "front", jpeg(220), [220, 220, 220, 255])
    await page.wait_for_selector(f"{figure}:not(.blind)")


@pytest.mark.slow
async def test_boxes_are_drawn_over_the_picture_and_can_be_switched_off(
    chromium: Browser, fake: Fake
) -> None:
    page = await chromium.open()
    await shown(fake, page, "front", jpeg(), [200, 200, 200, 255])
    can = Detection(label="can", confidence=0.9, box=(8, 4, 24, 12), position=(1.2, 0.0, 0.1))
    found = Detections(camera="front", width=32, height=16, things=(can,))

    async def overlay() -> int:
        """Publish the detections; return the number of drawn pixels."""
        fake.robot.publish(DETECTIONS, found)
        await asyncio.sleep(0.15)
        return sum(alpha > 0 for alpha in (await page.evaluate(PIXELS, ["front", 1]))[3::4])

    for _ in range(100):
        if drawn_pixels := await overlay():
            break
    assert drawn_pixels > 50
    name = await page.get_attribute('[data-camera="front"] .frame', "aria-label")
    assert name == "Picture of camera front: can"
    await page.click("#show-boxes")
    assert await overlay() == 0
    fake.presses.clear()
    await page.keyboard.press("Space")  # it stops, although a button has the focus
    await until(lambda: fake.presses == ["page"], "an e-stop")
    assert await overlay() == 0


async def test_folded_and_closed_cameras_get_no_pictures(chromium: Browser, fake: Fake) -> None:
    page = await chromium.open()
    await shown(fake, page, "front", jpeg(100), [100, 100, 100, 255])
    fold = page.locator('#pictures [data-camera="front"] figcaption button')
    await fold.click()
    assert await fold.get_attribute("aria-expanded") == "false"
    await page.wait_for_timeout(300)
    fake.robot.publish(IMAGE, jpeg(50), name="front")
    await page.wait_for_timeout(500)
    assert (await page.evaluate(PIXELS, ["front", 0]))[:4] == [100, 100, 100, 255]
    await fold.press("Enter")
    await shown(fake, page, "front", jpeg(50), [50, 50, 50, 255])
    await page.click("#show-cameras")
    assert not await page.is_visible("#pictures")
    await page.wait_for_timeout(300)
    fake.robot.publish(IMAGE, jpeg(150), name="front")
    await page.wait_for_timeout(500)
    assert (await page.evaluate(PIXELS, ["front", 0]))[:4] == [50, 50, 50, 255]


def violet(pixel: tuple[int, ...]) -> bool:
    return pixel[2] > pixel[1] + 10 and pixel[0] > pixel[1] + 5


def reddish(pixel: tuple[int, ...]) -> bool:
    return pixel[0] > pixel[1] + 30 and pixel[0] > pixel[2] + 30


def green(pixel: tuple[int, ...]) -> bool:
    return pixel[1] > pixel[0] + 30 and pixel[1] > pixel[2] + 20


async def test_contours_things_and_findings_are_on_the_map_and_can_be_switched_off(
    chromium: Browser,
) -> None:
    page = await chromium.open()
    await page.evaluate(LIGHT)
    await page.click("#theme")
    await page.click("#theme")
    await drawn(page, 1.3, 0.6, violet, "the low box")
    await drawn(page, 1.3, 1.4, reddish, "the step down")
    await drawn(page, -1.0, -1.05, green, "the ball")
    await drawn(page, 1.8, 1.63, violet, "the person")
    await page.click("#show-contours")
    await drawn(page, 1.3, 0.6, lambda pixel: not violet(pixel), "no low box")
    await page.click("#show-objects")
    await drawn(page, -1.0, -1.05, lambda pixel: not green(pixel), "no ball")
    await page.click("#show-perceived")
    await drawn(page, 1.8, 1.63, lambda pixel: not violet(pixel), "no person")


async def click_at(page: Page, x: float, y: float) -> None:
    """Click a place of the map [m]; the robot, at (0.5, 0), is in the middle."""
    box = await page.locator("#map").bounding_box()
    assert box
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await page.mouse.click(middle[0] + 90 * (x - 0.5), middle[1] - 90 * y)


async def test_a_click_on_a_thing_offers_to_go_there(chromium: Browser, fake: Fake) -> None:
    page = await chromium.open()
    await page.wait_for_selector("#show-objects")
    fake.goals.clear()
    await click_at(page, 0.0, -1.0)
    await page.wait_for_selector('#offer-text:has-text("can 3 · 90 %")')
    assert fake.goals == []  # the click itself sends no goal
    await page.keyboard.press("Escape")
    assert not await page.is_visible("#offer")
    await click_at(page, 0.0, -1.0)
    await page.keyboard.press("Enter")  # the button has the focus
    await until(lambda: len(fake.goals) == 1, "a goal")
    goal = fake.goals[0]
    assert goal.x is not None
    assert goal.y is not None
    assert goal.yaw is not None
    away = np.hypot(goal.x, goal.y + 1.0)
    assert 0.3 < away < 1.0  # a pose beside it, as there are two cans
    assert goal.yaw == pytest.approx(np.arctan2(-1.0 - goal.y, -goal.x), abs=0.01)  # facing it


async def test_goals_at_a_unique_thing_or_a_tag_are_sent_by_name(
    chromium: Browser, fake: Fake
) -> None:
    page = await chromium.open()
    await page.click("#tab-objects")
    fake.goals.clear()
    await page.get_by_label("Go to ball 5").click()
    await until(lambda: len(fake.goals) == 1, "a goal")
    await page.get_by_label("Go to tag 7").press("Enter")
    await until(lambda: len(fake.goals) == 2, "another goal")
    assert (fake.goals[0].object, fake.goals[0].x) == ("ball", None)
    assert (fake.goals[1].tag, fake.goals[1].object) == (7, "")


async def test_a_viewer_sees_things_and_pictures_but_sends_no_goal(
    chromium: Browser, fake: Fake
) -> None:
    page = await chromium.open(VIEWER)
    await page.wait_for_selector("#show-objects")
    await shown(fake, page, "front", jpeg(100), [100, 100, 100, 255])
    await click_at(page, 0.0, -1.0)
    await page.wait_for_selector('#offer-text:has-text("can 3")')
    assert not await page.is_visible("#offer-go")
    await page.click("#tab-objects")
    await page.wait_for_selector('#objects td:has-text("tag 7")')
    assert await page.locator("#objects button").count() == 0


async def test_on_a_phone_the_panel_opens_beside_the_map(chromium: Browser, fake: Fake) -> None:
    page = await chromium.open(width=390, height=844)
    await page.wait_for_selector("#show-cameras")
    assert not await page.is_visible("#pictures")
    await page.click("#show-cameras")
    await shown(fake, page, "front", jpeg(100), [100, 100, 100, 255])
    box = await page.locator('#pictures [data-camera="front"]').bounding_box()
    assert box
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= 390
    assert await page.evaluate("document.documentElement.scrollWidth") <= 390
