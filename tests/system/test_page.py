"""The operator page in a real browser: it shows the robot's state, and its controls work."""

import os
import re
import signal
from collections.abc import AsyncIterator, Iterator
from urllib.parse import unquote

import pytest
import pytest_asyncio
from playwright.async_api import Page, expect

from gigabrain_schemas.topics import BODY
from gigabrain_zenoh.config import yaml_text
from gigabrain_zenoh.qa.probe import Probe, at_rest, probing
from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from tests.system.page import VIEWER, Browser, Robot, browser, needs_browser

pytestmark = [needs_browser, pytest.mark.asyncio(loop_scope="module")]

ENABLED, LIVE = "#gate[data-mode=enabled]", "#link.live"
SHOWN = """() => ({
  link: document.querySelector('#link').textContent,
  doing: document.querySelector('#doing').textContent,
  stick: document.querySelector('#stick').outerHTML,
  focus: document.hasFocus(), hidden: document.hidden,
})"""  # the state of the controls, for a failure to steer


@pytest.fixture(scope="module")
def robot(shared_home: Home) -> Iterator[Robot]:
    robot = Robot(shared_home)
    yield robot
    robot.command.close()


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def seen(robot: Robot) -> AsyncIterator[Probe]:
    async with probing(robot.endpoint) as probe:
        yield probe


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def started(robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Browser]:
    await robot.served()
    async with browser(robot, tmp_path_factory.mktemp("profile")) as chromium:
        yield chromium


@pytest_asyncio.fixture(loop_scope="module")
async def chromium(started: Browser) -> AsyncIterator[Browser]:
    yield started
    await started.close_pages()


async def text(page: Page, name: str) -> str:
    return await page.inner_text(f"#{name}")


async def wait_for_text(page: Page, name: str, part: str) -> None:
    await page.wait_for_selector(f'#{name}:has-text("{part}")')


async def ready_to_drive(page: Page) -> None:
    """Bring the robot back to driving, from any state that an earlier test left."""
    await page.wait_for_selector("#gate:not([data-mode=stopping])")
    if await page.is_enabled("#release"):
        await page.wait_for_timeout(600)
        await page.click("#release")
        await wait_for_text(page, "reply", "released")
    await page.wait_for_selector("#enable:enabled")
    await page.click("#enable")
    await page.wait_for_selector(ENABLED)


async def turning(seen: Probe, page: Page) -> None:
    """Wait until the robot turns left, which its own brain never does."""
    try:
        await until(lambda: seen.state.velocity.angular_z > 0.3, "turning as commanded")
    except TimeoutError as error:
        raise AssertionError(f"{await page.evaluate(SHOWN)}; {seen.state.gate}") from error


async def hold_left(page: Page) -> None:
    """Press the joystick and push it to the left."""
    stick = page.locator("#stick")
    await stick.hover()  # at its middle, once it no longer moves
    await page.mouse.down()
    box = await stick.bounding_box()
    assert box
    await page.mouse.move(box["x"], box["y"] + box["height"] / 2)


async def test_a_held_key_drives_and_its_release_stops(chromium: Browser, seen: Probe) -> None:
    page = await chromium.open()
    await ready_to_drive(page)
    await page.keyboard.down("a")
    await turning(seen, page)
    await wait_for_text(page, "wanted", "0.00 m/s · 0.91 rad/s")
    await page.keyboard.up("a")
    await seen.at_rest()
    assert (seen.state.gate.mode, seen.state.gate.commander) == ("enabled", "control")
    assert "viewer" not in await text(page, "doing")


async def test_settings_are_changed_refused_and_offered_as_a_file(
    chromium: Browser, seen: Probe
) -> None:
    page = await chromium.open()
    bodies = seen.bus.latest(BODY)
    await page.click("#tab-settings")
    margin = page.get_by_label("stop_margin of driver")
    await margin.fill("0.02")
    await margin.press("Enter")
    await wait_for_text(page, "setting-reply", "below the body's own need, 0.08 m")
    await expect(margin).to_have_value("0.08")
    assert not await page.is_visible("#save-settings")
    await margin.fill("0.12")
    await margin.press("Enter")
    await wait_for_text(page, "setting-reply", "driver: stop_margin is 0.12 now, it was 0.08")
    await page.wait_for_selector("#settings tr.changed")
    await until(
        lambda: bodies.newest and bodies.newest.description.thresholds.stop_margin == 0.12,
        "the body has another margin",
    )
    file = await page.get_attribute("#save-settings", "href")
    assert file
    saved = yaml_text.read(unquote(file.partition(",")[2])).value
    assert saved == {"robot": {"thresholds": {"stop_margin": 0.12}}}
    await margin.fill("0.08")
    await margin.press("Enter")
    await page.wait_for_selector("#save-settings", state="hidden")


async def test_a_window_that_loses_the_focus_releases_all_keys(
    chromium: Browser, seen: Probe
) -> None:
    page = await chromium.open()
    await ready_to_drive(page)
    await page.keyboard.down("a")
    await turning(seen, page)
    await page.evaluate("window.dispatchEvent(new Event('blur'))")
    await seen.at_rest()
    await page.keyboard.up("a")


async def test_the_e_stop_stops_a_driving_robot_and_names_the_confirming_body(
    chromium: Browser, seen: Probe
) -> None:
    page = await chromium.open()
    await ready_to_drive(page)
    await page.keyboard.down("a")
    await turning(seen, page)
    before = seen.state.gate.estop_generation
    await page.keyboard.press("Space")
    await wait_for_text(page, "confirmed", "CONFIRMED by turtlebot3_waffle in ")
    assert re.search(
        r"in \d+ ms: stopped and latched; e-stop number \d+", await text(page, "confirmed")
    )
    await until(lambda: seen.state.gate.mode == "latched", "latched")
    await seen.at_rest()
    assert seen.state.gate.estop_generation == before + 1
    assert [cause.text for cause in seen.state.gate.causes] == ["e-stop pressed by page"]
    await wait_for_text(page, "causes", "find out why it was pressed")
    await page.keyboard.up("a")
    await page.keyboard.down("a")  # nothing is sent while the gate is latched
    await seen.ticks(50)
    assert at_rest(seen.state)
    await page.keyboard.up("a")
    await ready_to_drive(page)
    assert await text(page, "confirmed") == ""


async def test_a_goal_without_a_server_is_refused_on_the_page(chromium: Browser) -> None:
    page = await chromium.open()
    await page.click("#map", position={"x": 300, "y": 200})
    await wait_for_text(page, "goal", "no process serves goals")


async def test_tables_and_log_show_every_process(chromium: Browser) -> None:
    page = await chromium.open()
    for name in ("driver", "perception", "decision", "control", "safety", "page"):
        await wait_for_text(page, "processes", name)
    await page.click("#tab-topics")
    await wait_for_text(page, "topics", "robot/cmd_vel")
    rate = re.compile(r"robot/scan\s+\d+\.\d Hz\s+driver")
    await expect(page.locator("#topics")).to_have_text(rate, use_inner_text=True)
    await page.keyboard.press("ArrowRight")
    assert await page.get_attribute("#tab-log", "aria-selected") == "true"


async def test_only_one_of_two_viewers_steers_and_both_see_it(
    chromium: Browser, seen: Probe
) -> None:
    one, two = await chromium.open(), await chromium.open()
    await wait_for_text(two, "link", "2 viewers")
    await ready_to_drive(one)
    await one.keyboard.down("a")
    await turning(seen, one)
    await wait_for_text(two, "doing", "steered by viewer")
    await two.keyboard.down("d")
    await wait_for_text(two, "reply", "another page steers")
    await seen.ticks(25)
    assert seen.state.velocity.angular_z > 0.3
    await two.keyboard.up("d")
    await one.keyboard.up("a")
    await seen.at_rest()


async def test_a_viewers_token_shows_the_robot_and_cannot_drive_it(
    chromium: Browser, seen: Probe
) -> None:
    page = await chromium.open(VIEWER)
    assert await page.is_disabled("#estop")
    assert not await page.is_visible("#stick")
    assert not await page.is_visible("#enable")
    count = seen.bus.received["robot/teleop"]
    await page.keyboard.down("w")
    await page.keyboard.press("Space")
    await seen.ticks(25)
    assert seen.bus.received["robot/teleop"] == count
    assert await page.inner_text("#confirmed") == ""


async def test_on_a_phone_nothing_is_cut_off_and_the_joystick_drives(
    chromium: Browser, seen: Probe
) -> None:
    page = await chromium.open(width=390, height=844)
    assert await page.evaluate("document.documentElement.scrollWidth") == 390
    box = await page.locator("#estop").bounding_box()
    assert box
    assert box["y"] + box["height"] <= 844
    assert box["width"] > 340
    await ready_to_drive(page)
    await page.locator("#stick").scroll_into_view_if_needed()
    await page.evaluate("scrollBy(0, 150)")
    await hold_left(page)
    await turning(seen, page)
    await page.mouse.up()
    await seen.at_rest()


async def test_a_joystick_pressed_during_a_short_stop_steers_after_it(
    chromium: Browser, seen: Probe
) -> None:
    page = await chromium.open()
    await ready_to_drive(page)
    pid = await seen.pid("control")
    os.kill(pid, signal.SIGSTOP)
    try:
        await page.wait_for_selector(f"#gate:not({ENABLED.removeprefix('#gate')})")
        await hold_left(page)
    finally:
        os.kill(pid, signal.SIGCONT)
    await turning(seen, page)
    await page.mouse.up()
    await seen.at_rest()


async def test_controls_keep_their_places_when_the_robot_stops(
    chromium: Browser, seen: Probe
) -> None:
    page = await chromium.open()
    await ready_to_drive(page)
    names = "#estop", "#stick", "#release", "#take", "#enable"

    async def places() -> list[object]:
        return [await page.locator(name).bounding_box() for name in names]

    before = await places()
    pid = await seen.pid("control")
    os.kill(pid, signal.SIGSTOP)
    try:
        await wait_for_text(page, "causes", "control is silent")
        assert await places() == before
    finally:
        os.kill(pid, signal.SIGCONT)
    await page.click("#estop")
    await wait_for_text(page, "confirmed", "CONFIRMED by")
    await wait_for_text(page, "causes", "find out why it was pressed")
    assert await places() == before


@pytest.mark.slow
async def test_a_key_held_while_the_robot_was_latched_must_be_pressed_again(
    chromium: Browser, seen: Probe
) -> None:
    page, other = await chromium.open(), await chromium.open()
    await ready_to_drive(other)
    await page.bring_to_front()
    await page.keyboard.press("Space")
    await page.wait_for_selector("#gate[data-mode=latched]")
    for hold, release in (
        (lambda: hold_left(page), page.mouse.up),
        (lambda: page.keyboard.down("a"), lambda: page.keyboard.up("a")),
    ):
        await hold()
        await page.wait_for_timeout(200)  # for several frames
        await ready_to_drive(other)
        await page.wait_for_selector(ENABLED)
        await seen.ticks(25)
        assert seen.state.velocity.angular_z < 0.3
        assert "viewer" not in await text(page, "doing")
        await release()
        await page.keyboard.press("Space")
        await page.wait_for_selector("#gate[data-mode=latched]")
    await ready_to_drive(page)
    await hold_left(page)
    await turning(seen, page)
    await page.mouse.up()
    await seen.at_rest()


async def test_the_page_reconnects_when_its_server_restarts_and_drives_again(
    chromium: Browser, seen: Probe
) -> None:
    page = await chromium.open()
    await ready_to_drive(page)
    await page.keyboard.down("a")
    await turning(seen, page)
    os.kill(await seen.pid("page"), signal.SIGKILL)
    await page.wait_for_selector("#link:not(.live)")
    assert await page.inner_text("#mode") == "Silent"
    await seen.at_rest()
    await page.keyboard.press("Space")
    await wait_for_text(page, "confirmed", "NOT CONFIRMED: ")
    await page.wait_for_selector(LIVE)
    await page.keyboard.up("a")
    await ready_to_drive(page)
    await page.keyboard.down("a")
    await turning(seen, page)
    await page.keyboard.up("a")
    await seen.at_rest()
