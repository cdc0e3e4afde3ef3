"""The page's map of a robot that publishes on all topics."""

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
import pytest_asyncio
from playwright.async_api import Page, expect

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import Body
from gigabrain_schemas.topics import BODY
from gigabrain_zenoh.testing.waiting import until
from tests.system.fake_page import Fake, serving
from tests.system.page import OPERATOR, Browser, browser, needs_browser

pytestmark = [needs_browser, pytest.mark.asyncio(loop_scope="module")]

PADS = """
const button = (pressed) => ({ pressed, value: pressed ? 1 : 0 })
const buttons = () => Array.from({ length: 16 }, () => button(false))
const idle = () => ({ axes: [0, 0, 0, 0], buttons: buttons() })
window.pads = [idle(), idle()]
navigator.getGamepads = () => [null, ...window.pads]
"""
COUNTED = """
window.sent = 0
const send = WebSocket.prototype.send
WebSocket.prototype.send = function (frame) { window.sent++; send.call(this, frame) }
"""
QUICK_CHECKS = """
window.sockets = []
window.WebSocket = class extends WebSocket {
  constructor(...args) { super(...args); sockets.push(this) }
}
const every = setInterval
window.setInterval = (act, ms) => every(act, ms / 20)
"""
RESTARTED_DRIVER = """async () => {
  const { MapView } = await import('/map.js')
  const view = new MapView(document.createElement('canvas'), () => {})
  const head = new DataView(new ArrayBuffer(20))
  head.setFloat32(0, 0.05, true)
  head.setUint32(12, 1, true)
  head.setUint32(16, 1, true)
  view.setMap(head, new Int8Array(1))
  view.setTask({ goal: { x: 3, y: 0, yaw: null } })
  const at = (x) => ({ x, y: 0, yaw: 0 })
  const frame = (boot, x) => ({ state: { boot, pose: at(x) }, pose: at(x), frame: 'odom' })
  const silent = { state: null, pose: null, frame: 'odom' }
  for (const robot of [frame(1, 0), frame(1, 1), silent, frame(2, 5)]) view.setRobot(robot)
  return [view.trail, Boolean(view.map), view.goal.x]
}"""  # returns the driven path, whether there is a map, and the goal
MOVE_STICK_LEFT = """() => {
  const stick = document.getElementById('stick'), box = stick.getBoundingClientRect(), before = sent
  const at = { clientX: box.left + 5, clientY: box.top + box.height / 2 }
  for (let i = 0; i < 200; i++) stick.dispatchEvent(new PointerEvent('pointermove', at))
  return sent - before
}"""  # returns how many frames that has sent


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def fake(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Fake]:
    fake = Fake(tmp_path_factory.mktemp("fake"))
    async with serving(fake):
        yield fake


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def chromium(fake: Fake, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Browser]:
    async with browser(fake, tmp_path_factory.mktemp("profile")) as chromium:
        yield chromium


async def colour(page: Page, x: float, y: float) -> tuple[int, ...]:
    """Return the RGBA pixel at a place of the map [m]; the robot, at (0.5, 0), is in the middle."""
    pixel = await page.evaluate(
        """([x, y]) => {
          const canvas = document.getElementById('map'), ratio = devicePixelRatio
          const at = [canvas.width / 2 + x * 90 * ratio, canvas.height / 2 - y * 90 * ratio]
          return [...canvas.getContext('2d').getImageData(...at.map(Math.round), 1, 1).data]
        }""",
        [x - 0.5, y],
    )
    return tuple(pixel)


async def drawn(
    page: Page, x: float, y: float, is_it: Callable[[tuple[int, ...]], bool], what: str
) -> None:
    for _ in range(600):
        seen = await colour(page, x, y)
        if is_it(seen):
            return
        await asyncio.sleep(0.1)
    raise AssertionError(f"{what} is not at ({x}, {y}), where {seen} is")


def dark(pixel: tuple[int, ...]) -> bool:
    return max(pixel[:3]) < 40 and pixel[3] == 255


def light(pixel: tuple[int, ...]) -> bool:
    return min(pixel[:3]) > 240 and pixel[3] == 255


def nothing(pixel: tuple[int, ...]) -> bool:
    return pixel[3] == 0


def blue(pixel: tuple[int, ...]) -> bool:
    return pixel[2] > 90 and pixel[0] < 80


def violet(pixel: tuple[int, ...]) -> bool:
    return pixel[0] > pixel[1] + 30 and pixel[2] > pixel[1] + 10


async def test_map_robot_path_obstacle_and_goal_are_drawn_at_their_places(
    chromium: Browser,
) -> None:
    page = await chromium.open()
    await page.evaluate("document.documentElement.dataset.theme = 'light'")
    await page.click("#theme")
    await page.click("#theme")
    await drawn(page, -1.475, -0.3, dark, "the wall")
    await drawn(page, -1.2, -0.3, light, "free floor")
    await drawn(page, 1.3, 1.7, nothing, "the unknown")
    await drawn(page, 0.85, 0.005, blue, "the expected trajectory")
    await drawn(page, 0.5, 0.8, violet, "the obstacle")
    await drawn(page, 1.73, 0.2, violet, "the wall ahead, as it was seen")
    assert light(await colour(page, 1.45, 0.2)), "no disc of its size"
    await page.wait_for_selector('#goal:has-text("3.1 m left")')
    assert "about 16 s" in await page.inner_text("#goal")
    assert "then evening round" in await page.inner_text("#goal")
    for _ in range(600):  # the text may be shown before the path is drawn
        dashes = sum([blue(await colour(page, 0.5, y / 100)) for y in range(-140, -60, 2)])
        if dashes:
            break
    assert 5 < dashes < 35  # a dashed line


async def test_a_click_sends_a_goal_in_the_map_and_a_drag_its_heading(
    chromium: Browser, fake: Fake
) -> None:
    page = await chromium.open()
    await page.wait_for_selector('#goal:has-text("left")')
    box = await page.locator("#map").bounding_box()
    assert box
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await page.mouse.click(x + 90, y)
    await until(lambda: len(fake.goals) == 1, "a goal")
    await page.mouse.move(x, y - 90)
    await page.mouse.down()
    await page.mouse.move(x, y - 180, steps=3)
    await page.mouse.up()
    await until(lambda: len(fake.goals) == 2, "a goal with a heading")
    plain, turned = fake.goals
    assert (round(plain.x, 2), round(plain.y, 2), plain.yaw) == (1.5, 0.0, None)
    assert turned.yaw
    assert (round(turned.x, 2), round(turned.y, 2), round(turned.yaw, 2)) == (0.5, 1.0, 1.57)
    assert plain.source == "page"
    await page.click("#cancel")
    await page.wait_for_selector('#reply:has-text("goal-7 is cancelled")')
    assert [(change.do, change.source) for change in fake.changes] == [("cancel", "page")]


async def test_a_gamepad_drives_while_a_shoulder_button_is_held(
    chromium: Browser, fake: Fake
) -> None:
    page = await chromium.open(before=PADS)
    await page.wait_for_selector("#gate[data-mode=enabled]")
    await page.evaluate("pads[0].axes = [0, -1, -0.5, 0]")
    await page.wait_for_timeout(300)
    assert fake.steered == []  # no shoulder button
    await page.evaluate("pads[0].buttons[5].pressed = true")
    await until(lambda: len(fake.steered) > 3, "steered")
    wanted = fake.steered[-1]
    # the slider is at half of the body's limits; half a stick is half of that
    assert (round(wanted.linear_x, 3), round(wanted.angular_z, 3)) == (0.13, 0.455)
    await page.evaluate("pads[0].buttons[5].pressed = false")
    await until(lambda: fake.steered[-1].linear_x == 0.0, "a zero at the end")
    count = len(fake.steered)
    await page.wait_for_timeout(300)
    assert len(fake.steered) == count
    await page.evaluate("pads[0].buttons[1].pressed = true")
    await page.wait_for_selector('#confirmed:has-text("CONFIRMED by")')
    await page.wait_for_timeout(200)
    assert fake.presses == ["page"]  # once, for as long as the button is held


async def test_button_b_of_any_gamepad_stops_while_a_key_or_the_joystick_is_held(
    chromium: Browser, fake: Fake
) -> None:
    page = await chromium.open(before=PADS)
    await page.wait_for_selector("#gate[data-mode=enabled]")
    fake.presses.clear()
    await page.keyboard.down("w")
    await until(lambda: fake.steered and fake.steered[-1].linear_x > 0, "driven by a key")
    await page.evaluate("pads[0].buttons[1].pressed = true")
    await until(lambda: fake.presses == ["page"], "stopped while a key is held")
    await until(lambda: fake.steered[-1].linear_x == 0.0, "the key counts as released")
    await page.keyboard.up("w")
    await page.hover("#stick", position={"x": 60, "y": 5})
    await page.mouse.down()
    await until(lambda: fake.steered[-1].linear_x > 0, "driven by the joystick")
    await page.evaluate("pads[1].buttons[1].pressed = true")
    await until(lambda: fake.presses == ["page"] * 2, "stopped while the joystick is held")
    await page.mouse.up()


async def test_moving_the_joystick_sends_no_additional_commands(
    chromium: Browser, fake: Fake
) -> None:
    page = await chromium.open(before=COUNTED)
    await page.wait_for_selector("#gate[data-mode=enabled]")
    await page.hover("#stick", position={"x": 60, "y": 5})
    await page.mouse.down()
    await until(lambda: fake.steered and fake.steered[-1].linear_x > 0, "driven")
    # more moves at once than frames that the server accepts in a second
    assert await page.evaluate(MOVE_STICK_LEFT) == 0
    await until(lambda: fake.steered[-1].angular_z > 0, "turned as the joystick was moved")
    await page.mouse.up()
    await until(lambda: fake.steered[-1].angular_z == 0, "a zero at the end")


@pytest.mark.parametrize("file", ["main.js", "link.js", "style.css"])
async def test_a_page_reloads_if_one_of_its_files_did_not_arrive(
    chromium: Browser, file: str
) -> None:
    await chromium.lose(file)
    page = await chromium.open()
    await expect(page.locator("header")).to_have_css("display", "flex")
    await expect(page.locator("#link")).to_have_class("badge live")


async def test_a_connection_whose_end_is_not_reported_is_replaced(chromium: Browser) -> None:
    page = await chromium.open(before=QUICK_CHECKS)
    await page.evaluate("sockets[0].onmessage = null")  # as when the robot loses its power
    await page.wait_for_selector("#link:not(.live)")
    assert await page.evaluate("sockets[0].readyState") == 1  # open
    await page.wait_for_selector("#link.live")
    assert await page.evaluate("sockets.map((one) => one.readyState > 1)") == [True, False]


async def test_an_address_with_a_token_logs_in_an_open_page(chromium: Browser, fake: Fake) -> None:
    page = await chromium.open()
    await page.evaluate("sessionStorage.clear()")
    await page.goto(fake.origin)
    await page.wait_for_selector("#login[open]")
    await page.goto(f"{fake.origin}/#{OPERATOR}")  # only the part after # changes
    await page.wait_for_selector("#link.live")
    assert await page.evaluate("location.hash") == ""


async def test_an_address_with_a_percent_sign_opens_the_page(chromium: Browser, fake: Fake) -> None:
    page = await chromium.open()
    await page.goto(f"{fake.origin}/#100%-of-nothing")
    await page.wait_for_selector("#login[open]")


async def test_a_restarted_driver_begins_a_new_path_on_the_same_map(
    chromium: Browser,
) -> None:
    page = await chromium.open()
    assert await page.evaluate(RESTARTED_DRIVER) == [[[5, 0]], True, 3]


class FakeWithoutMap(Fake):
    """A robot that makes no map."""

    def publish_once(self) -> None:
        body = load_robot("turtlebot3_waffle").description()
        self.robot.publish(BODY, Body(description=body, link="sim"))


async def test_a_new_connection_removes_the_map_of_an_earlier_run(tmp_path: Path) -> None:
    first = Fake(tmp_path)
    async with browser(first, tmp_path / "profile") as chromium:
        async with serving(first):
            page = await chromium.open()
            await drawn(page, -1.5, 0.5, dark, "the wall")
        async with serving(FakeWithoutMap(tmp_path, port=first.config.port)):
            await page.wait_for_selector("#link.live")
            await drawn(page, -1.5, 0.5, nothing, "the floor")
