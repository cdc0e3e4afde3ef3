"""What the page draws of a robot that says all there is to say, over plain HTTP and over TLS."""

import asyncio
import contextlib
import datetime
import math
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
import pytest_asyncio
from msgspec.structs import replace
from playwright.async_api import Page

from gigabrain_drivers.catalog import load_robot
from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.brain import (
    Intent,
    Obstacle,
    OccupancyGrid,
    PoseInMap,
    TrajectoryPoint,
    Twist,
    WorldModel,
)
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.requests import EstopRequest, GateReply
from gigabrain_schemas.sensors import Image, LaserScan
from gigabrain_schemas.tasks import GoalReply, GoalRequest, TaskReply, TaskRequest, TaskStatus
from gigabrain_schemas.topics import (
    BODY,
    ESTOP,
    GOAL,
    IMAGE,
    INTENT,
    MAP,
    POSE,
    SCAN,
    STATE,
    TASK,
    TASK_CHANGE,
    TELEOP,
    WORLD,
)
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.page.server import run
from gigabrain_zenoh.settings import PageConfig
from gigabrain_zenoh.transport import LocalNetwork
from tests.page_rig import OPERATOR, VIEWER, Browser, browser, needs_browser
from tests.stack import free_port, until

pytestmark = [needs_browser, pytest.mark.asyncio(loop_scope="module")]

SIDE = 80  # cells of the map, of 0.05 m; its corner is at (-2, -2)
PAD = """
const button = (pressed) => ({ pressed, value: pressed ? 1 : 0 })
window.pad = { axes: [0, 0, 0, 0], buttons: Array.from({ length: 16 }, () => button(false)) }
navigator.getGamepads = () => [window.pad]
"""


def wall_ahead() -> LaserScan:
    """The lidar of a Waffle, 0.064 m behind its middle, sees a wall 1.2 m ahead of that."""
    angles = np.radians(np.arange(-20, 21))
    return LaserScan(
        angle_min=float(angles[0]), angle_increment=math.radians(1.0), range_min=0.1, range_max=3.5,
        ranges=ranges_bytes((1.2 + 0.064) / np.cos(angles)),
    )  # fmt: skip


class Fake:
    """A robot with all topics, which stands at (0.5, 0) in its map and at (1, 1) by odometry."""

    def __init__(self, folder: Path, **config: object) -> None:
        network = LocalNetwork()
        self.robot = Bus(network.transport(), Clock(), "driver")
        self.bus = Bus(network.transport(), Clock(), "page")
        tokens = folder / "tokens.json"
        tokens.touch(0o600)
        tokens.write_text(f'{{"operator": "{OPERATOR}", "viewer": "{VIEWER}"}}')
        values = {"port": free_port(), "tokens": str(tokens), "login": True} | config
        self.config = msgspec.convert(values, PageConfig)
        self.goals: list[GoalRequest] = []
        self.changes: list[TaskRequest] = []
        self.steered: list[Twist] = []
        self.robot.subscribe(TELEOP, lambda _key, twist: self.steered.append(twist))
        self.robot.serve(GOAL, self._go)
        self.robot.serve(TASK_CHANGE, self._change)
        self.presses: list[str] = []
        self.robot.serve(ESTOP, self._stop)

    @property
    def origin(self) -> str:
        scheme = "https" if self.config.certificate else "http"
        return f"{scheme}://127.0.0.1:{self.config.port}"

    async def _go(self, goal: GoalRequest) -> GoalReply:
        self.goals.append(goal)
        return GoalReply(ok=True, text="on the way, 4.2 m", goal="goal-7")

    async def _stop(self, request: EstopRequest) -> GateReply:
        self.presses.append(request.source)
        reply = EXAMPLES["GateReply"]
        assert isinstance(reply, GateReply)
        return replace(reply, gate=replace(reply.gate, mode="latched"))

    async def _change(self, request: TaskRequest) -> TaskReply:
        self.changes.append(request)
        return TaskReply(ok=True, text="goal-7 is cancelled")

    def say(self) -> None:
        """All that is said again and again."""
        state = EXAMPLES["RobotState"]
        assert isinstance(state, RobotState)
        gate = replace(state.gate, mode="enabled", commander="control", causes=())
        state = replace(state, pose=Pose(x=1.0, y=1.0, yaw=0.0), gate=gate)
        self.robot.publish(STATE, state)
        self.robot.publish(POSE, PoseInMap(x=0.5, y=0.0, yaw=0.0, covariance=(0.0,) * 9))
        thing = Obstacle(id=1, x=1.0, y=1.8, radius=0.3)  # so at (0.5, 0.8) in the map
        wall = Obstacle(id=2, x=2.2, y=1.0, radius=0.45)
        world = WorldModel(scan_ok=True, obstacle_ahead=False, obstacles=(thing, wall))
        self.robot.publish(WORLD, world)
        self.robot.publish(SCAN, wall_ahead())
        way = tuple(TrajectoryPoint(t=i / 10, x=i / 10, y=0.0, yaw=0.0) for i in range(11))
        intent = Intent(trajectory=way, behaviour="navigate", reason="on its way to the kitchen")
        self.robot.publish(INTENT, intent)

    def say_once(self) -> None:
        """What is kept for those who come late."""
        body = load_robot("turtlebot3_waffle").description()
        self.robot.publish(BODY, Body(description=body, link="sim"))
        cells = np.zeros((SIDE, SIDE), np.int8)
        cells[:, 10] = 100  # a wall at x = -1.5
        cells[60:, 40:] = -1
        self.robot.publish(
            MAP,
            OccupancyGrid(
                resolution=0.05, width=SIDE, height=SIDE, origin_x=-2.0, origin_y=-2.0,
                cells=cells.tobytes(),
            ),
        )  # fmt: skip
        task = EXAMPLES["TaskStatus"]
        assert isinstance(task, TaskStatus)
        self.robot.publish(TASK, replace(task, path=((0.5, 0.0), (0.5, -1.5), (1.5, -1.5))))


@contextlib.asynccontextmanager
async def serving(fake: Fake) -> AsyncIterator[None]:
    ready = asyncio.Event()
    server = asyncio.ensure_future(run(fake.config, fake.bus, ready.set))

    async def talk() -> None:
        while True:
            fake.say()
            await asyncio.sleep(0.05)

    fake.say_once()
    talking = asyncio.ensure_future(talk())
    await ready.wait()
    try:
        yield
    finally:
        for task in (talking, server):
            task.cancel()
        await asyncio.gather(talking, server, return_exceptions=True)


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def fake(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Fake]:
    made = Fake(tmp_path_factory.mktemp("fake"))
    async with serving(made):
        yield made


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def chromium(fake: Fake, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Browser]:
    async with browser(fake, tmp_path_factory.mktemp("profile")) as made:
        yield made


async def colour(page: Page, x: float, y: float) -> tuple[int, ...]:
    """What is drawn at a place of the map [m]; the robot, at (0.5, 0), is in the middle."""
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


async def test_map_robot_way_obstacle_and_goal_are_drawn_where_they_are(chromium: Browser) -> None:
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
    for _ in range(600):  # it may be drawn a moment after it is told
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
    await page.wait_for_selector('#said:has-text("goal-7 is cancelled")')
    assert [(change.do, change.source) for change in fake.changes] == [("cancel", "page")]


async def test_pictures_of_cameras_are_drawn(chromium: Browser, fake: Fake) -> None:
    page = await chromium.open()
    grey = Image(frame_id="cam", encoding="mono8", height=1, width=2, data=b"\x00\xff")
    rgb = Image(frame_id="cam", encoding="rgb8", height=1, width=1, data=b"\x0a\x14\x1e")
    for camera, picture in (("front", grey), ("rear", rgb)):
        fake.robot.publish(IMAGE, picture, name=camera)
        figure = f'#pictures [data-camera="{camera}"]'
        await page.wait_for_selector(f"{figure} canvas[width='{picture.width}']")
        pixels = await page.evaluate(
            """(figure) => { const canvas = document.querySelector(`${figure} canvas`)
            return [...canvas.getContext('2d')
              .getImageData(0, 0, canvas.width, canvas.height).data] }""",
            figure,
        )
        expected = [0, 0, 0, 255, 255, 255, 255, 255] if camera == "front" else [10, 20, 30, 255]
        assert pixels == expected
        assert await page.inner_text(f"{figure} figcaption") == camera


async def test_a_gamepad_drives_while_a_shoulder_button_is_held(
    chromium: Browser, fake: Fake
) -> None:
    page = await chromium.open(before=PAD)
    await page.wait_for_selector("#gate[data-mode=enabled]")
    await page.evaluate("pad.axes = [0, -1, -0.5, 0]")
    await page.wait_for_timeout(300)
    assert fake.steered == []  # no shoulder button
    await page.evaluate("pad.buttons[5].pressed = true")
    await until(lambda: len(fake.steered) > 3, "steered")
    wanted = fake.steered[-1]
    # half of what the body can, as the slider stands; half of that for half a stick
    assert (round(wanted.linear_x, 3), round(wanted.angular_z, 3)) == (0.13, 0.455)
    await page.evaluate("pad.buttons[5].pressed = false")
    await until(lambda: fake.steered[-1].linear_x == 0.0, "a zero at the end")
    count = len(fake.steered)
    await page.wait_for_timeout(300)
    assert len(fake.steered) == count
    await page.evaluate("pad.buttons[1].pressed = true")
    await page.wait_for_selector('#confirmed:has-text("CONFIRMED by")')
    await page.wait_for_timeout(200)
    assert fake.presses == ["page"]  # once, for as long as the button is held


def certificate(folder: Path) -> dict[str, str]:
    """A page's own certificate, as people make one."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "127.0.0.1")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .sign(key, hashes.SHA256())
    )
    plain = serialization.NoEncryption()
    form = serialization.PrivateFormat.PKCS8
    pem = serialization.Encoding.PEM
    (folder / "page.crt").write_bytes(made.public_bytes(pem))
    (folder / "page.key").write_bytes(key.private_bytes(pem, form, plain))
    return {"certificate": str(folder / "page.crt"), "certificate_key": str(folder / "page.key")}


async def test_over_tls_a_token_opens_the_page_to_drive_and_another_to_look(
    tmp_path: Path,
) -> None:
    pytest.importorskip("cryptography")
    fake = Fake(tmp_path, **certificate(tmp_path))
    async with serving(fake), browser(fake, tmp_path / "profile") as chromium:
        page = await chromium.open()
        assert page.url.startswith("https://")
        await page.wait_for_selector("#gate[data-mode=enabled]")
        await page.keyboard.down("w")
        await until(lambda: fake.steered and fake.steered[-1].linear_x > 0.1, "steered")
        await page.keyboard.up("w")
        await until(lambda: fake.steered[-1].linear_x == 0.0, "let go")
        viewer = await chromium.open(VIEWER)
        assert await viewer.is_disabled("#estop")
        count = len(fake.steered)
        await viewer.keyboard.press("w")
        stranger = await chromium.open(VIEWER)
        await stranger.evaluate("sessionStorage.clear()")
        await stranger.goto(f"{fake.origin}/#a-wrong-token-of-some-length")
        await stranger.reload()
        await stranger.wait_for_selector("#login[open]")
        await stranger.fill("#token", OPERATOR)
        await stranger.click("#login button")
        await stranger.wait_for_selector("#link.live")
        assert len(fake.steered) == count
