"""Driving ends when a control is released, also if the browser does not report the release."""

import asyncio
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
from playwright.async_api import Dialog, Page

from gigabrain_zenoh.testing.waiting import until
from tests.system.fake_page import Fake, serving
from tests.system.page import Browser, browser, needs_browser
from tests.system.test_page_map import PADS

pytestmark = [needs_browser, pytest.mark.asyncio(loop_scope="module")]


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def fake(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Fake]:
    fake = Fake(tmp_path_factory.mktemp("fake"))
    async with serving(fake):
        yield fake


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def chromium(fake: Fake, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Browser]:
    async with browser(fake, tmp_path_factory.mktemp("profile")) as chromium:
        yield chromium


async def opened(chromium: Browser, fake: Fake) -> Page:
    page = await chromium.open(before=PADS)
    await page.wait_for_selector("#gate[data-mode=enabled]")
    fake.steered.clear()
    return page


async def drives(fake: Fake) -> None:
    await until(lambda: fake.steered and fake.steered[-1].linear_x > 0, "driven")


async def stays_at_rest(page: Page, fake: Fake) -> None:
    await until(lambda: not fake.steered or fake.steered[-1].linear_x == 0.0, "a zero at the end")
    count = len(fake.steered)
    await page.wait_for_timeout(500)
    assert len(fake.steered) == count


async def test_a_key_released_while_cmd_is_held_stops_driving(
    chromium: Browser, fake: Fake
) -> None:
    page = await opened(chromium, fake)
    await page.keyboard.down("w")
    await drives(fake)
    await page.keyboard.down("Meta")  # on macOS, no keyup of "w" is reported any more
    await stays_at_rest(page, fake)
    await page.keyboard.up("Meta")
    await page.keyboard.up("w")


async def test_a_key_released_while_a_dialog_is_open_stops_driving(
    chromium: Browser, fake: Fake
) -> None:
    page = await opened(chromium, fake)
    await page.keyboard.down("w")
    await drives(fake)

    async def answer(dialog: Dialog) -> None:
        await asyncio.sleep(1.5)  # the key is released meanwhile, which is not reported to the page
        await dialog.dismiss()

    page.once("dialog", answer)
    await page.evaluate("confirm('Load the map?')")
    await stays_at_rest(page, fake)
    await page.keyboard.up("w")


async def test_a_gamepad_held_while_the_robot_was_latched_must_be_pressed_again(
    chromium: Browser, fake: Fake
) -> None:
    page = await opened(chromium, fake)
    await page.evaluate("pads[0].axes[1] = -1; pads[0].buttons[5].pressed = true")
    await drives(fake)
    fake.mode = "latched"
    await page.wait_for_selector("#gate[data-mode=latched]")
    await stays_at_rest(page, fake)
    fake.mode = "enabled"
    await page.wait_for_selector("#gate[data-mode=enabled]")
    await stays_at_rest(page, fake)
    await page.evaluate("pads[0].buttons[5].pressed = false")
    await page.wait_for_timeout(200)
    await page.evaluate("pads[0].buttons[5].pressed = true")
    await drives(fake)
    await page.close()


async def test_a_gamepad_drives_only_in_the_window_with_the_focus(
    chromium: Browser, fake: Fake
) -> None:
    page = await opened(chromium, fake)
    await page.evaluate("document.hasFocus = () => false")
    await page.evaluate("pads[0].axes[1] = -1; pads[0].buttons[5].pressed = true")
    await stays_at_rest(page, fake)
    await page.evaluate("document.hasFocus = () => true")
    await stays_at_rest(page, fake)  # until the button is pressed again
    fake.presses.clear()
    await page.evaluate("document.hasFocus = () => false; pads[0].buttons[1].pressed = true")
    await until(lambda: fake.presses == ["page"], "stopped also without the focus")


async def test_the_joystick_ignores_the_right_button_and_opens_no_menu(
    chromium: Browser, fake: Fake
) -> None:
    page = await opened(chromium, fake)
    await page.evaluate(
        "addEventListener('contextmenu', (event) => { window.menu = !event.defaultPrevented })"
    )
    await page.hover("#stick", position={"x": 60, "y": 5})
    await page.mouse.down(button="right")
    await page.wait_for_timeout(500)
    assert fake.steered == []
    await page.mouse.up(button="right")
    assert await page.evaluate("menu") is False  # a menu would hide the release of the left button
