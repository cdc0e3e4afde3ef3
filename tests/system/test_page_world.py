"""The simulated world on the operator page: it is drawn, and changed by clicks."""

import asyncio
from collections.abc import AsyncIterator, Iterator

import numpy as np
import pytest
import pytest_asyncio
from numpy.typing import NDArray
from playwright.async_api import Page

from gigabrain_drivers.sim.png import read_png
from gigabrain_schemas.sim import SimReply, SimRequest
from gigabrain_schemas.topics import SIM_CHANGE
from gigabrain_zenoh.qa.probe import Probe, probing
from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from tests.system.page import VIEWER, Browser, Robot, browser, needs_browser

pytestmark = [needs_browser, pytest.mark.asyncio(loop_scope="module")]

MAX_SCREENSHOTS = 300


@pytest.fixture(scope="module")
def robot(shared_home: Home, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    world = tmp_path_factory.mktemp("world") / "hall.yaml"
    world.write_text("size: [8, 8]\nstart: [0, 0, 0]\n")
    robot = Robot(shared_home, world=str(world), decision={"settings": {"max_linear_speed": 0.01}})
    yield robot
    robot.command.close()


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def seen(robot: Robot) -> AsyncIterator[Probe]:
    async with probing(robot.endpoint) as probe:
        yield probe


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def chromium(
    robot: Robot, tmp_path_factory: pytest.TempPathFactory
) -> AsyncIterator[Browser]:
    await robot.served()
    async with browser(robot, tmp_path_factory.mktemp("profile")) as chromium:
        yield chromium


async def opened(chromium: Browser, **how: str) -> Page:
    page = await chromium.open(**how)
    await page.wait_for_selector("#show-world:not([hidden])")
    await page.click("#show-world")
    return page


async def picture(page: Page) -> NDArray[np.uint8]:
    """Return the grey values of the middle of the view, where no buttons are."""
    data = await page.locator("#world").screenshot()
    whole = read_png(data, "the view", 8_000_000)
    height, width = whole.shape
    return whole[height // 4 : -height // 4, width // 4 : -width // 4]


async def changed(page: Page, before: NDArray[np.uint8], pixels: int) -> None:
    for _ in range(MAX_SCREENSHOTS):
        now = await picture(page)
        if (np.abs(now.astype(int) - before) > 20).sum() > pixels:
            return
        await asyncio.sleep(0.1)
    raise AssertionError("the view has not changed")


async def things(seen: Probe) -> SimReply:
    (reply,) = await seen.bus.ask(SIM_CHANGE, SimRequest(), timeout_s=5.0)
    return reply


async def click_beside(
    page: Page, dx: float, dy: float, *, to: tuple[float, float] | None = None
) -> None:
    """Click `dx`, `dy` pixels right of and below the robot, in the middle; or drag from there."""
    area = await page.locator("#world").bounding_box()
    assert area
    x, y = area["x"] + area["width"] / 2, area["y"] + area["height"] / 2
    await page.mouse.move(x + dx, y + dy)
    await page.mouse.down()
    if to:
        await page.mouse.move(x + to[0], y + to[1], steps=5)
    await page.mouse.up()


@pytest.mark.slow
async def test_things_are_added_to_the_world_by_clicks_and_drawn(
    chromium: Browser, seen: Probe
) -> None:
    page = await opened(chromium)
    await page.wait_for_function("document.querySelector('#world').width > 300")
    empty = await picture(page)
    await page.click("[data-tool=box]")
    await click_beside(page, 120, 40)
    await page.wait_for_selector('#goal:has-text("box1 is at")')
    await changed(page, empty, 200)
    await page.click("[data-tool=person]")
    await click_beside(page, -150, 40, to=(-150, -60))
    await page.wait_for_selector('#goal:has-text("person1 is at")')
    reply = await things(seen)
    box, person = reply.things
    assert (box.kind, person.kind) == ("box", "person")
    assert reply.robot
    assert 0.4 < np.hypot(box.x - reply.robot.x, box.y - reply.robot.y) < 3.0
    assert len(person.path) == 1
    before = await picture(page)
    await changed(page, before, 100)  # the person walks
    await page.click("[data-tool=remove]")
    await click_beside(page, 120, 40)
    await page.wait_for_selector('#goal:has-text("box1 is gone")')
    assert [thing.name for thing in (await things(seen)).things] == ["person1"]
    await click_beside(page, 120, 150)
    await page.wait_for_selector("#goal.bad")


async def test_a_refusal_is_shown(chromium: Browser) -> None:
    page = await opened(chromium)
    await page.click("[data-tool=cylinder]")
    await click_beside(page, 0, 0)
    await page.wait_for_selector('#goal.bad:has-text("the robot is in the way")')


async def test_a_drag_turns_the_view_and_sends_nothing(chromium: Browser, seen: Probe) -> None:
    page = await opened(chromium)
    await page.wait_for_function("document.querySelector('#world').width > 300")
    before, count = await picture(page), len((await things(seen)).things)
    await click_beside(page, -100, 0, to=(150, 50))
    await changed(page, before, 1000)
    assert len((await things(seen)).things) == count


async def test_a_viewers_token_sees_the_world_without_tools(chromium: Browser) -> None:
    page = await opened(chromium, token=VIEWER)
    await page.wait_for_selector("#world:not([hidden])")
    assert await page.locator("[data-tool=box]").is_hidden()
    await until(lambda: not chromium.faults)
