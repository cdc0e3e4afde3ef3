"""Zones, places and maps that a person edits on the page."""

import asyncio
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
from playwright.async_api import expect

from gigabrain_schemas.requests import MapReply, MapRequest
from gigabrain_schemas.topics import MAP_LIST, MAP_LOAD, MAP_SAVE, ZONES, ZONES_CHANGE
from gigabrain_schemas.zones import (
    MapListReply,
    MapListRequest,
    MapLoadRequest,
    Place,
    SavedMapInfo,
    Zone,
    Zones,
    ZonesReply,
    ZonesRequest,
)
from gigabrain_zenoh.testing.waiting import until
from tests.system.fake_page import Fake, serving
from tests.system.page import VIEWER, Browser, browser, needs_browser
from tests.system.test_page_map import drawn

pytestmark = [needs_browser, pytest.mark.asyncio(loop_scope="module")]


class FakeWithMaps(Fake):
    """A robot with zones and saved maps."""

    answer_s = 0.0  # delay of its answers

    async def change(self, request: ZonesRequest) -> ZonesReply:
        await asyncio.sleep(self.answer_s)
        self.wanted.append(request)
        ok = not (request.zone and request.zone.name == "bad")
        return ZonesReply(ok=ok, text="done" if ok else "zone 'bad': its edges cross")

    async def list(self, _request: MapListRequest) -> MapListReply:
        await asyncio.sleep(self.answer_s)
        maps = (SavedMapInfo(name="house"), SavedMapInfo(name="old", problem="cut"))
        return MapListReply(maps=maps, present="house")

    async def save(self, request: MapRequest) -> MapReply:
        self.saved.append(request)
        refusal = "not saved: there is a map attic.yaml already; --replace overwrites it"
        return MapReply(ok=request.replace, text="saved attic" if request.replace else refusal)

    async def load(self, request: MapLoadRequest) -> MapReply:
        self.loaded.append(request)
        return MapReply(ok=True, text="loaded house; looking for the robot in it")

    def serve(self) -> None:
        self.wanted: list[ZonesRequest] = []
        self.saved: list[MapRequest] = []
        self.loaded: list[MapLoadRequest] = []
        self.robot.serve(ZONES_CHANGE, self.change)
        self.robot.serve(MAP_LIST, self.list)
        self.robot.serve(MAP_SAVE, self.save)
        self.robot.serve(MAP_LOAD, self.load)
        square = ((0.9, -0.9), (1.5, -0.9), (1.5, -0.3), (0.9, -0.3))
        self.robot.publish(
            ZONES,
            Zones(
                zones=(Zone(name="lab", kind="keepout", points=square),),
                places=(Place(name="desk", x=0.0, y=-1.0, yaw=0.0),),
                map="house",
            ),
        )


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def fake(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[FakeWithMaps]:
    fake = FakeWithMaps(tmp_path_factory.mktemp("fake"))
    fake.serve()
    async with serving(fake):
        yield fake


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def chromium(fake: Fake, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Browser]:
    async with browser(fake, tmp_path_factory.mktemp("profile")) as chromium:
        yield chromium


def reddish(pixel: tuple[int, ...]) -> bool:
    return pixel[0] > pixel[1] + 15 and pixel[0] > pixel[2] + 15


async def test_zones_are_drawn_and_created_by_clicks(chromium: Browser, fake: FakeWithMaps) -> None:
    page = await chromium.open()
    await drawn(page, 1.2, -0.75, reddish, "the zone")
    await page.click("#edit-zones")
    box = await page.locator("#map").bounding_box()
    assert box
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await page.click('[data-zone="speed"]')
    for dx, dy in ((45, 0), (90, 0), (90, 45)):
        await page.mouse.click(x + dx, y + dy)
    await page.fill("#zone-value", "0.15")
    await page.click("#zone-finish")
    await until(lambda: len(fake.wanted) == 1, "a speed zone")
    zone = fake.wanted[0].zone
    assert zone
    assert (zone.name, zone.kind, zone.max_speed) == ("speed 1", "speed", 0.15)
    assert zone.points == ((1.0, 0.0), (1.5, 0.0), (1.5, -0.5))
    assert fake.goals == []
    await page.click('[data-zone="one_way"]')
    await page.mouse.click(x + 45, y)
    await page.click("#zone-finish")
    await page.wait_for_selector('#zone-note.bad:has-text("1 more point is needed")')
    await page.mouse.click(x + 90, y)
    await page.fill("#zone-name", "bad")
    await page.click("#zone-finish")
    await page.wait_for_selector("#zone-note.bad:has-text(\"zone 'bad': its edges cross\")")
    lane = fake.wanted[1].zone
    assert lane
    assert (lane.kind, lane.lane_width, lane.max_speed) == ("one_way", 1.0, None)
    await page.keyboard.press("Escape")
    await page.mouse.click(x + 45, y)
    await until(lambda: len(fake.goals) == 1, "a click is a goal again")


async def test_a_drag_sets_the_heading_of_a_place_and_a_click_removes_it(
    chromium: Browser, fake: FakeWithMaps
) -> None:
    page = await chromium.open()
    await drawn(page, 1.2, -0.75, reddish, "the zone")
    fake.wanted.clear()
    await page.click("#edit-zones")
    box = await page.locator("#map").bounding_box()
    assert box
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await page.click('[data-zone="place"]')
    await page.fill("#zone-name", "door")
    await page.mouse.move(x + 45, y)
    await page.mouse.down()
    await page.mouse.move(x + 135, y, steps=3)
    await page.mouse.up()
    await until(lambda: len(fake.wanted) == 1, "a place")
    assert fake.wanted[0].place == Place(name="door", x=1.0, y=0.0, yaw=0.0)
    await page.click('[data-zone="remove"]')
    await page.mouse.click(x - 45, y + 90)
    await until(lambda: len(fake.wanted) == 2, "a place to remove")
    await page.mouse.click(x + 63, y + 54)
    await until(lambda: len(fake.wanted) == 3, "a zone to remove")
    assert [one.remove for one in fake.wanted[1:]] == ["desk", "lab"]


async def test_maps_are_saved_and_loaded(chromium: Browser, fake: FakeWithMaps) -> None:
    page = await chromium.open()
    page.on("dialog", lambda dialog: dialog.accept())
    await page.click("#edit-zones")
    await page.wait_for_selector('#map-name:has-text("map: house")')
    await expect(page.locator("#maps option:not([disabled])")).to_have_text("house")
    await page.fill("#map-save-name", "attic")
    await page.click("#map-save")
    await page.wait_for_selector('#zone-note:has-text("saved attic")')
    assert [one.replace for one in fake.saved] == [False, True]
    await page.click("#map-load")
    await page.wait_for_selector('#zone-note:has-text("looking for the robot in it")')
    assert (fake.loaded[0].name, fake.loaded[0].mapping) == ("house", "localize")


async def test_a_viewer_sees_zones_but_cannot_change_them(chromium: Browser) -> None:
    page = await chromium.open(VIEWER)
    await drawn(page, 1.2, -0.75, reddish, "the zone")
    assert not await page.is_visible("#edit-zones")


async def test_the_page_waits_as_long_as_its_server_for_zones_and_maps(
    chromium: Browser, fake: FakeWithMaps, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = await chromium.open()
    await drawn(page, 1.2, -0.75, reddish, "the zone")
    monkeypatch.setattr(fake, "answer_s", 4.0)
    await page.click("#edit-zones")
    await page.click('[data-zone="place"]')
    box = await page.locator("#map").bounding_box()
    assert box
    await page.mouse.click(box["x"] + box["width"] / 2 + 45, box["y"] + box["height"] / 2)
    note = page.locator("#zone-note")
    await expect(note).to_have_text("done")  # the page waits for the answers
    await expect(page.locator("#maps option")).to_have_text(["house", "old"])
