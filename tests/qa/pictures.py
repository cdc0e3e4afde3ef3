"""Takes the screenshots of the operator page for the docs: python -m tests.qa.pictures FOLDER."""

import asyncio
import sys
import tempfile
from pathlib import Path

from playwright.async_api import Page, async_playwright

from gigabrain_drivers.sim.worlds import mission_file
from gigabrain_zenoh.qa.probe import Probe, probing
from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from gigabrain_zenoh.ui.run_report import RunMonitor
from tests.system.page import CHROMIUM, FLAGS, OPERATOR, Robot

READY_S = 600.0  # a machine without compiled kernels compiles them first
MAPPED_M2, MAP_S = 45.0, 300.0  # mapped area that a screenshot shows, and time until then
NAVIGATES = {
    "perception": {"mapping": "slam"},
    "decision": {"behaviour": "navigate", "settings": {"start": "explore"}},
    "speed": 2.0,  # in lock-step, so that a busy machine does not make it stop
}
SIZES = {"light": (1280, 800), "phone": (390, 844), "dark": (1280, 800)}
ROOM = """
description: a room with a table, low boxes, cans, a ball, a person and a tag
size: [6, 5]
start: [-1.8, 0, 0]
boxes:
  - {at: [0.9, 1.2], size: [1.2, 0.7, 0.03], bottom: 0.42, material: wood}
  - {at: [0.4, 0.95], size: [0.05, 0.05, 0.42], material: dark_wood}
  - {at: [1.4, 0.95], size: [0.05, 0.05, 0.42], material: dark_wood}
  - {at: [0.4, 1.45], size: [0.05, 0.05, 0.42], material: dark_wood}
  - {at: [1.4, 1.45], size: [0.05, 0.05, 0.42], material: dark_wood}
  - {at: [-0.4, -0.7], size: [0.3, 0.2, 0.08], yaw: 0.4, material: carton}
  - {at: [1.9, -0.6], size: [0.4, 0.3, 0.3], yaw: 0.2, material: carton}
cans:
  - {at: [-0.5, 0.35]}
  - {at: [0.3, -0.2]}
balls:
  - {at: [0.2, 0.4], radius: 0.1}
tags:
  - {id: 7, at: [2.45, 0.6], yaw: 3.14159, z: 0.25, size: 0.2}
people:
  - {path: [[0.8, -1.6], [1.6, -1.6]], speed: 0.1}
"""


async def take_screenshots(folder: Path) -> None:
    """Take all screenshots."""
    await take_map_screenshots(folder)
    await take_camera_screenshot(folder)
    await take_arm_screenshot(folder)


async def take_arm_screenshot(folder: Path) -> None:
    """Have an arm move blocks, and show it while it carries one."""
    decision = {"behaviour": "navigate", "settings": {"mission": mission_file("blocks", Path())}}
    with tempfile.TemporaryDirectory() as place:
        home = Home(Path(place) / "home")
        try:
            robot = Robot(home, body="so101", world="table", decision=decision)
            async with probing(robot.endpoint) as seen:
                await robot.served()
                async with async_playwright() as playwright:
                    chromium = await playwright.chromium.launch(
                        executable_path=CHROMIUM, args=FLAGS
                    )
                    page = await chromium.new_page()
                    await page.goto(f"{robot.origin}/#{OPERATOR}")
                    await prepare(page, "light")
                    await until(lambda: carries(seen), "it carries a block", READY_S)
                    await page.screenshot(path=folder / "page_arm.png")
                    await chromium.close()
        finally:
            home.close()


def carries(seen: Probe) -> bool:
    """Return whether the gripper squeezes something while the arm turns."""
    pan, *_, gripper = seen.state.joints
    squeezed = gripper.position - seen.state.joints_sent[-1] > 0.05
    return squeezed and abs(pan.velocity) > 0.3


async def take_camera_screenshot(folder: Path) -> None:
    """Explore a room with cameras until a thing is known, and show what they see."""
    with tempfile.TemporaryDirectory() as place:
        home = Home(Path(place) / "home")
        world = home.folder / "room.yaml"
        world.write_text(ROOM)
        try:
            robot = Robot(home, world=str(world), cameras=True, **NAVIGATES)
            await robot.served()
            async with async_playwright() as playwright:
                chromium = await playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
                page = await chromium.new_page()
                await page.goto(f"{robot.origin}/#{OPERATOR}")
                await prepare(page, "light")
                for seen in ("#show-contours", "#tab-objects"):
                    await page.wait_for_selector(seen, timeout=READY_S * 1000)
                await page.click("#tab-objects")
                await page.wait_for_timeout(1200)  # the table is filled once a second
                await page.screenshot(path=folder / "page_cameras.png")
                await chromium.close()
        finally:
            home.close()


async def take_map_screenshots(folder: Path) -> None:
    """Explore the house; the dark screenshot shows the topics."""
    with tempfile.TemporaryDirectory() as place:
        home = Home(Path(place) / "home")
        try:
            robot = Robot(home, world="house", seed=1, **NAVIGATES)
            async with probing(robot.endpoint) as seen:
                watch = RunMonitor(seen.bus)
                await robot.served()
                await until(lambda: watch.task.current, "decision is ready", READY_S)
                await until(lambda: watch.mapped_m2, "a map", READY_S)
                async with async_playwright() as playwright:
                    chromium = await playwright.chromium.launch(
                        executable_path=CHROMIUM, args=FLAGS
                    )
                    page = await chromium.new_page()
                    await page.goto(f"{robot.origin}/#{OPERATOR}")
                    for name in SIZES:
                        await prepare(page, name)
                        await until(lambda: is_worth_a_screenshot(watch), "a way in a map", MAP_S)
                        await page.screenshot(path=folder / f"page_{name}.png")
                    await chromium.close()
        finally:
            home.close()


def is_worth_a_screenshot(watch: RunMonitor) -> bool:
    """Return whether enough is mapped, and the robot drives to a goal more than 2 m away."""
    task, state = watch.task.current, watch.state.fresh()
    far = task is not None and (task.distance_remaining or 0.0) > 2.0
    drives = state is not None and state.gate.mode == "enabled" and state.velocity.linear_x > 0.1
    return far and drives and (watch.mapped_m2 or 0.0) > MAPPED_M2


async def prepare(page: Page, name: str) -> None:
    """Set size and colours of the page; one page serves all, as several would slow the robot."""
    width, height = SIZES[name]
    await page.set_viewport_size({"width": width, "height": height})
    await page.emulate_media(color_scheme="dark" if name == "dark" else "light")
    if name == "dark":
        await page.click("#tab-topics")
    await page.wait_for_selector("#link.live")
    await page.wait_for_timeout(1200)  # the tables are drawn once a second


if __name__ == "__main__":
    asyncio.run(take_screenshots(Path(sys.argv[1])))
