"""Pictures at the operator page: only for browsers that watch, at their pace, without a queue."""

import struct
from collections.abc import AsyncIterator
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas.brain import (
    Contour,
    DetectedObject,
    Objects,
    OccupancyGrid,
    WorldModel,
)
from gigabrain_schemas.examples import example
from gigabrain_schemas.objects import Detection, Detections, ObjectMap
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import (
    CAMERA,
    DETECTIONS,
    IMAGE,
    MAP,
    OBJECT_MAP,
    PERCEIVED,
    STATE,
    WORLD,
)
from gigabrain_schemas.vision import CameraInfo
from gigabrain_zenoh.testing.waiting import settle
from gigabrain_zenoh.ui.page import frames
from gigabrain_zenoh.ui.page.cameras import Shown, Watch
from tests.unit.recording.bags import jpeg_head
from tests.unit.ui.test_page_places import Page, Socket

FRAME_NS = 100_000_000


@pytest.fixture
async def page(tmp_path: Path) -> AsyncIterator[Page]:
    page = Page(tmp_path)
    yield page
    await page.close()


def send(socket: Socket, kind: int, content: msgspec.Struct) -> None:
    socket.to_server.put_nowait(frames.as_json(kind, content))


async def watching(page: Page, *folded: str) -> Socket:
    """Connect a viewer that has the panel open."""
    socket = await page.connect(page.tokens.viewer)
    send(socket, frames.WATCH, Watch(open=True, folded=folded))
    await settle()
    page.sessions.send_new_frames()
    await settle()
    return socket


def picture(width: int = 320, height: int = 240, data: bytes = b"") -> Image:
    data = data or jpeg_head(320, 240)
    return Image(frame_id="front", encoding="jpeg", width=width, height=height, data=data)


async def tick(page: Page) -> None:
    """Let a tenth of a second pass, and send what is due."""
    await page.net.clock.advance(FRAME_NS)
    page.sessions.send_new_frames()
    for _ in range(3):
        await settle()


def pictures(socket: Socket) -> list[str]:
    """Return the cameras of the pictures that a browser received, in order."""
    images = (frame for frame in socket.received if frame[0] == frames.IMAGE)
    return [struct.unpack_from("64s", frame, 12)[0].rstrip(b"\0").decode() for frame in images]


def patterns(page: Page) -> list[str]:
    """Return the keys that are subscribed on the bus."""
    return sorted(key for key, _ in page.net.network._listeners)


def content(socket: Socket, kind: int) -> list[dict[str, object]]:
    return [msgspec.json.decode(frame[1:]) for frame in socket.received if frame[0] == kind]


async def test_pictures_are_subscribed_only_while_a_browser_watches(page: Page) -> None:
    quiet = patterns(page)
    viewer = await watching(page)
    subscribed = set(patterns(page)) - set(quiet)
    assert {"robot/image/*", "robot/detections", "robot/perceived/*"} <= subscribed
    send(viewer, frames.WATCH, Watch())
    await settle()
    page.sessions.send_new_frames()
    assert not {"robot/image/*", "robot/detections"} & set(patterns(page))
    page.sessions.viewers.clear()
    page.sessions.send_new_frames()
    assert patterns(page) == quiet


async def test_a_browser_gets_the_next_picture_after_it_has_shown_the_last(page: Page) -> None:
    slow = await watching(page)
    for _ in range(20):
        page.net.two.publish(IMAGE, picture(), name="front")
        await tick(page)
    assert pictures(slow) == ["front"]  # 2 s without an acknowledgement
    send(slow, frames.SHOWN, Shown(camera="front"))
    await settle()
    for _ in range(5):
        page.net.two.publish(IMAGE, picture(), name="front")
        await tick(page)
    assert pictures(slow) == ["front", "front"]


async def test_a_quick_browser_gets_five_pictures_a_second_of_a_flood(page: Page) -> None:
    quick = await watching(page)
    for _ in range(20):
        for _ in range(10):
            page.net.two.publish(IMAGE, picture(), name="front")
        await tick(page)
        send(quick, frames.SHOWN, Shown(camera="front"))
        await settle()
    assert len(pictures(quick)) == 10


async def test_the_same_picture_is_not_sent_twice(page: Page) -> None:
    viewer = await watching(page)
    page.net.two.publish(IMAGE, picture(), name="front")
    for _ in range(10):
        await tick(page)
        send(viewer, frames.SHOWN, Shown(camera="front"))
        await settle()
    assert pictures(viewer) == ["front"]


async def test_a_second_viewer_gets_the_newest_picture_too(page: Page) -> None:
    first, second = await watching(page), await watching(page)
    page.net.two.publish(IMAGE, picture(), name="front")
    await tick(page)
    assert pictures(first) == pictures(second) == ["front"]


async def test_folded_cameras_and_more_than_eight_are_not_sent(page: Page) -> None:
    viewer = await watching(page, "cam3")
    for number in range(20):
        page.net.two.publish(IMAGE, picture(), name=f"cam{number}")
    await tick(page)
    assert pictures(viewer) == [f"cam{number}" for number in range(8) if number != 3]


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (jpeg_head(65500, 65500), "a JPEG of 65500 x 65500 pixels; its message says 320 x 240"),
        (b"\xff\xd8\xff", "not a JPEG, or one without a size"),
    ],
    ids=["bomb", "cut off"],
)
async def test_a_picture_that_contradicts_its_message_is_not_sent_to_browsers(
    page: Page, data: bytes, problem: str
) -> None:
    viewer = await watching(page)
    page.net.two.publish(IMAGE, picture(data=data), name="front")
    await tick(page)
    assert pictures(viewer) == []
    assert content(viewer, frames.CAMERA) == [{"camera": "front", "problem": problem}]
    page.net.two.publish(IMAGE, picture(), name="front")
    await tick(page)
    assert pictures(viewer) == ["front"]
    assert content(viewer, frames.CAMERA)[-1] == {"camera": "front", "problem": ""}


async def test_a_picture_that_cannot_be_decoded_is_skipped(page: Page) -> None:
    viewer = await watching(page)
    page.net.network.deliver("robot/image/front", b"garbage")
    await tick(page)
    assert pictures(viewer) == []


async def test_a_camera_problem_is_sent_once_and_kept_for_later_viewers(page: Page) -> None:
    viewer = await page.connect(page.tokens.viewer)
    info = example(CameraInfo)
    for _ in range(3):
        page.net.two.publish(CAMERA, msgspec.structs.replace(info, problem="covered"), name="front")
        await settle()
    later = await page.connect(page.tokens.viewer)
    expected = [{"camera": "front", "problem": "covered"}]
    assert content(viewer, frames.CAMERA) == content(later, frames.CAMERA) == expected


async def test_detections_are_sent_only_to_browsers_that_show_the_picture(page: Page) -> None:
    open_, folded = await watching(page), await watching(page, "front")
    can = Detection(label="can", confidence=0.93456, box=(1.23456, 2, 3, 4), in_map=(1.0, 2.0, 3.0))
    found = Detections(camera="front", width=320, height=240, things=(can,))
    page.net.two.publish(DETECTIONS, found)
    await tick(page)
    (sent,) = content(open_, frames.FOUND)
    assert sent["things"] == [
        {"label": "can", "confidence": 0.93, "box": [1.2, 2.0, 3.0, 4.0], "position": None}
    ]
    assert content(folded, frames.FOUND) == []


async def test_detections_are_shown_with_their_own_picture(page: Page) -> None:
    """Pictures come at 10 Hz. Every second one is recognised; its detections come 0.1 s later."""
    viewer = await watching(page)
    shown: list[tuple[int, int]] = []
    for number in range(1, 41):
        data = jpeg_head(320, 240) + bytes((number,))
        page.net.two.publish(IMAGE, picture(data=data), name="front", basis=5 * number)
        if number <= 20 and number % 2 == 0 and number > 2:  # recognition ends after 20
            can = Detection(label=f"can {number - 1}", confidence=0.9, box=(1.0, 2.0, 3.0, 4.0))
            found = Detections(camera="front", width=320, height=240, things=(can,))
            page.net.two.publish(DETECTIONS, found, basis=5 * (number - 1))
        await tick(page)
        send(viewer, frames.SHOWN, Shown(camera="front"))
        await settle()
        images = [frame[-1] for frame in viewer.received if frame[0] == frames.IMAGE]
        if not shown or len(images) > shown[-1][1]:
            shown.append((images[-1], len(images)))
    numbers = [number for number, _ in shown]
    assert numbers == sorted(set(numbers))  # never back in time
    assert [n for n in numbers if 5 < n < 20] == [7, 9, 11, 13, 15, 17, 19]  # those recognised
    assert len([n for n in numbers if n > 26]) >= 6  # without recognition, all pictures again
    both = [frame for frame in viewer.received if frame[0] in (frames.IMAGE, frames.FOUND)]
    for (kind, frame), (after, boxes) in pairwise((frame[0], frame) for frame in both):
        if kind == frames.IMAGE and 7 <= frame[-1] <= 19:  # boxes come with their picture
            assert after == frames.FOUND
            assert f'"can {frame[-1]}"'.encode() in boxes


async def test_pictures_of_a_quick_camera_wait_for_late_detections(page: Page) -> None:
    """Pictures come at 50 Hz, and every fifth is recognised; its detections come 0.44 s later."""
    viewer = await watching(page)
    for basis in range(1, 201):
        data = jpeg_head(320, 240) + bytes((basis,))
        page.net.two.publish(IMAGE, picture(data=data), name="front", basis=basis)
        if basis % 5 == 0 and basis > 22:
            found = Detections(camera="front", width=320, height=240)
            page.net.two.publish(DETECTIONS, found, basis=basis - 22)
            await tick(page)
            send(viewer, frames.SHOWN, Shown(camera="front"))
            await settle()
    numbers = [frame[-1] for frame in viewer.received if frame[0] == frames.IMAGE]
    assert len(numbers) >= 10
    assert all((number + 22) % 5 == 0 for number in numbers[2:])  # only those recognised


async def test_contours_are_sent_once_each_and_removed(page: Page) -> None:
    viewer = await page.connect(page.tokens.viewer)
    page.net.two.publish(STATE, example(STATE.type))
    box = Contour(polygon=((1.00004, 0.0), (2.0, 0.0), (2.0, 1.0)), bottom=0.0, top=0.05)
    for basis, shown in ((1, (box,)), (1, (box,)), (2, ()), (3, ())):
        world = WorldModel(scan_ok=True, obstacle_ahead=False, contours=shown)
        page.net.two.publish(WORLD, world, basis=basis)
        await tick(page)
    first, last = content(viewer, frames.CONTOURS)
    assert first[0]["polygon"] == [[1.0, 0.0], [2.0, 0.0], [2.0, 1.0]]  # type: ignore[index]
    assert last == []
    assert all(b'"polygon"' not in frame for frame in viewer.received if frame[0] == frames.STATE)


async def test_findings_and_the_map_of_objects_are_sent(page: Page) -> None:
    viewer = await page.connect(page.tokens.viewer)
    page.sessions.send_new_frames()
    person = DetectedObject(id=1, x=2.0, y=1.0, radius=0.3, label="person")
    page.net.two.publish(PERCEIVED, Objects(objects=(person,)), name="people")
    page.net.two.publish(OBJECT_MAP, example(ObjectMap))
    await tick(page)
    (found,) = content(viewer, frames.PERCEIVED)
    assert (found["name"], len(found["objects"])) == ("people", 1)  # type: ignore[arg-type]
    assert len(content(viewer, frames.OBJECTS)) == 1
    later = await page.connect(page.tokens.viewer)
    assert len(content(later, frames.OBJECTS)) == 1


async def test_a_map_is_sent_when_it_changes_and_to_viewers_that_connect_later(page: Page) -> None:
    viewer, grid = await page.connect(page.tokens.viewer), example(OccupancyGrid)
    for cells in (grid.cells, grid.cells, bytes(len(grid.cells))):
        page.net.two.publish(MAP, msgspec.structs.replace(grid, cells=cells))
        await tick(page)
    assert [frame[0] for frame in viewer.received].count(frames.MAP) == 2
    later = await page.connect(page.tokens.viewer)
    assert [frame[0] for frame in later.received].count(frames.MAP) == 1


async def test_a_frame_that_the_page_never_sends_ends_the_connection(page: Page) -> None:
    for kind, bad in ((frames.WATCH, b'{"open": 1}'), (frames.SHOWN, b"{}"), (frames.WATCH, b"x")):
        socket = await page.connect(page.tokens.viewer)
        socket.to_server.put_nowait(bytes((kind,)) + bad)
        for _ in range(5):
            await settle()
        assert socket.code == 1008
