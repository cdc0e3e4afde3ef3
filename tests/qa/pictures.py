"""Takes the docs' screenshots of the operator page: `python -m tests.qa.pictures FOLDER`."""

import asyncio
import sys
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import replace
from playwright.async_api import Page, async_playwright

from gigabrain_drivers.sim.worlds import mission_file
from gigabrain_schemas.sim import SimRequest, Thing
from gigabrain_schemas.topics import SIM_CHANGE, ZONES_CHANGE
from gigabrain_schemas.zones import Place, Zone, ZonesRequest
from gigabrain_zenoh.geometry.pose import compose, inverse, to_frame
from gigabrain_zenoh.qa.probe import Probe, probing
from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from gigabrain_zenoh.ui.run_report import RunMonitor
from tests.system.page import CHROMIUM, FLAGS, OPERATOR, Robot

READY_S = 600.0  # a machine without compiled kernels compiles them first
MAPPED_M2, MAP_TIMEOUT_S = 45.0, 300.0  # least mapped area in a screenshot
NAVIGATES: dict[str, Any] = {
    "perception": {"mapping": "slam"},
    "decision": {"behaviour": "navigate", "settings": {"start": "explore"}},
    "speed": 2.0,  # in lock-step, so that it does not stop on a busy machine
}
DRAWN_MS = 1200  # the tables are drawn once a second
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


THINGS = (
    Thing(kind="box", x=-0.2, y=-2.2, yaw=0.4),
    Thing(kind="person", x=-3.0, y=-0.9, yaw=-1.0),
)
ZONES = (  # in the house's own frame
    Zone(name="bath", kind="keepout", points=((1.7, 0.1), (4.4, 0.1), (4.4, 3.4), (1.7, 3.4))),
    Zone(name="door", kind="one_way", points=((-0.2, -1.0), (-0.2, 1.0)), lane_width=0.9),
    Zone(
        name="living room",
        kind="speed",
        points=((-4.4, -3.4), (-1.2, -3.4), (-1.2, -0.2), (-4.4, -0.2)),
        max_speed=0.1,
    ),
)
PLACES = (Place(name="kitchen", x=2.0, y=-2.2), Place(name="bed", x=-2.3, y=1.0))


class Scene(NamedTuple):
    """A probe on a robot, and the page in a browser."""

    seen: Probe
    page: Page


@asynccontextmanager
async def shown(world: str, text: str = "", **deployment: Any) -> AsyncIterator[Scene]:
    """Start a robot in a world, or in one with the file content `text`, and open its page."""
    with tempfile.TemporaryDirectory() as place, closing(Home(Path(place) / "home")) as home:
        if text:
            file = home.folder / world
            file.write_text(text)
            world = str(file)
        robot = Robot(home, world=world, **deployment)
        await robot.served()
        async with probing(robot.endpoint) as seen, async_playwright() as playwright:
            chromium = await playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            page = await chromium.new_page()
            await page.goto(f"{robot.origin}/#{OPERATOR}")
            await prepare(page, "light")
            yield Scene(seen, page)
            await chromium.close()


async def take_screenshots(folder: Path) -> None:
    """Take all screenshots."""
    await take_map_screenshots(folder)
    await take_world_screenshot(folder)
    await take_camera_screenshot(folder)
    await take_arm_screenshot(folder)


async def take_arm_screenshot(folder: Path) -> None:
    """Let an arm move blocks, and take a screenshot while it carries one."""
    decision = {"behaviour": "navigate", "settings": {"mission": mission_file("blocks", Path())}}
    async with shown("table", body="so101", decision=decision) as (seen, page):
        await until(lambda: carries(seen), "it carries a block", READY_S)
        await page.screenshot(path=folder / "page_arm.png")


def carries(seen: Probe) -> bool:
    """Return whether the gripper holds something while the arm turns."""
    pan, *_, gripper = seen.state.joints
    squeezed = gripper.position - seen.state.joints_sent[-1] > 0.05
    return squeezed and abs(pan.velocity) > 0.3


async def take_camera_screenshot(folder: Path) -> None:
    """Explore a room with cameras until an object is known, and take a screenshot."""
    async with shown("room.yaml", ROOM, cameras=True, **NAVIGATES) as (_, page):
        for part in ("#show-contours", "#tab-objects"):
            await page.wait_for_selector(part, timeout=READY_S * 1000)
        await page.click("#tab-objects")
        await page.wait_for_timeout(DRAWN_MS)
        await page.screenshot(path=folder / "page_cameras.png")


async def take_world_screenshot(folder: Path) -> None:
    """Put a box and a person into the house, and take a screenshot in 3-D."""
    async with shown("house", seed=1) as (seen, page):
        for thing in THINGS:
            request = SimRequest(do="add", thing=thing)
            (reply,) = await seen.bus.ask(SIM_CHANGE, request, timeout_s=READY_S)
            assert reply.ok, reply.text
        await page.click("#show-world")
        await page.click("[data-tool=person]")
        await page.wait_for_function("document.querySelector('#world').width > 300")
        await page.wait_for_timeout(DRAWN_MS)
        await page.screenshot(path=folder / "page_world.png")


async def take_map_screenshots(folder: Path) -> None:
    """Explore the house; the dark screenshot shows the topics, the last one zones."""
    async with shown("house", seed=1, **NAVIGATES) as (seen, page):
        watch = RunMonitor(seen.bus)
        await until(lambda: watch.task.current, "decision is ready", READY_S)
        await until(lambda: watch.mapped_m2, "a map", READY_S)
        for name in SIZES:
            await prepare(page, name)
            await until(lambda: is_worth_a_screenshot(watch), "a way in a map", MAP_TIMEOUT_S)
            await page.screenshot(path=folder / f"page_{name}.png")
        for zone in await zones_in_map(seen):
            (reply,) = await seen.bus.ask(ZONES_CHANGE, zone, timeout_s=READY_S)
            assert reply.ok, reply.text
        await prepare(page, "light")
        for button in ("#tab-processes", *("#zoom-out",) * 4, "#edit-zones"):
            await page.click(button)
        await page.click("[data-zone=keepout]")
        await page.wait_for_timeout(DRAWN_MS)
        await page.screenshot(path=folder / "page_zones.png")


async def zones_in_map(seen: Probe) -> list[ZonesRequest]:
    """Return requests for all zones and places, in the map; its origin is the robot's start."""
    (reply,) = await seen.bus.ask(SIM_CHANGE, SimRequest(), timeout_s=READY_S)
    assert reply.robot
    begin = compose(reply.robot, inverse(seen.state.pose))
    requests = []
    for zone in ZONES:
        points = tuple(to_frame(begin, x, y) for x, y in zone.points)
        requests.append(ZonesRequest(zone=replace(zone, points=points)))
    for place in PLACES:
        x, y = to_frame(begin, place.x, place.y)
        requests.append(ZonesRequest(place=replace(place, x=x, y=y)))
    return requests


def is_worth_a_screenshot(watch: RunMonitor) -> bool:
    """Return whether enough is mapped, and the robot drives to a goal more than 2 m away."""
    task, state = watch.task.current, watch.state.fresh()
    far = task is not None and (task.distance_remaining or 0.0) > 2.0
    drives = state is not None and state.gate.mode == "enabled" and state.velocity.linear_x > 0.1
    return far and drives and (watch.mapped_m2 or 0.0) > MAPPED_M2


async def prepare(page: Page, name: str) -> None:
    """Set size and colours of the page; several pages would slow the robot down."""
    width, height = SIZES[name]
    await page.set_viewport_size({"width": width, "height": height})
    await page.emulate_media(color_scheme="dark" if name == "dark" else "light")
    if name == "dark":
        await page.click("#tab-topics")
    await page.wait_for_selector("#link.live")
    await page.wait_for_timeout(DRAWN_MS)


if __name__ == "__main__":
    asyncio.run(take_screenshots(Path(sys.argv[1])))
