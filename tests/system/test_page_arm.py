"""An arm on the operator page: its joints are shown, and move only while a button is held."""

import asyncio
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import pytest_asyncio
from msgspec.structs import replace
from numpy.typing import NDArray
from playwright.async_api import Page

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import Cause, Pose, Velocity
from gigabrain_schemas.body import ArmModel, Body, BodyDescription, GateStatus, Joint, RobotState
from gigabrain_schemas.brain import ArmPlan, GraspPose, JointSpeeds
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import GateReply, LimpRequest
from gigabrain_schemas.topics import ARM_MODEL, ARM_PLAN, BODY, JOINT_TELEOP, LIMP, STATE
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT
from tests.system.fake_page import Fake, serving
from tests.system.page import VIEWER, Browser, browser, needs_browser

pytestmark = [needs_browser, pytest.mark.asyncio(loop_scope="module")]

MODEL = (ROOT / "drivers/gigabrain_drivers/bodies/so101/model.xml").read_text("utf-8")
ARM = load_robot("so101").description()
SLIDER = replace(ARM.joints[-1], unit="m", lower=0.0, upper=0.04)
CRANE = replace(ARM, joints=(*ARM.joints[:-1], SLIDER))  # with a sliding gripper
DRIVES = replace(
    ARM, robot_type="mobile", drive_type="omni", max_linear_speed=0.3, max_lateral_speed=0.3,
    max_angular_speed=1.0,
)  # fmt: skip
READY = GateStatus(mode="enabled", commander="control", enables=1)
LATCHED = GateStatus(mode="latched", estop_generation=1, enables=1)
MAX_SCREENSHOTS = 300
Colour = NDArray[np.float64]  # of each pixel, 0 to 255
PAN = "shoulder_pan up: hold to move it"


class FakeArm(Fake):
    """An arm without a simulation; the test sets the state that its driver publishes."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.body: BodyDescription = CRANE
        self.gate, self.limp = READY, False
        self.jogged: list[JointSpeeds] = []
        self.limp_requests: list[bool] = []  # True: go limp; False: hold
        self.robot.serve(LIMP, self._let_go)
        self.robot.subscribe(JOINT_TELEOP, lambda _key, speeds: self.jogged.append(speeds))

    def become(self, body: BodyDescription = CRANE, gate: GateStatus = READY) -> None:
        """Become another robot, and forget the commands to the last one."""
        self.body, self.gate, self.limp = body, gate, False
        self.jogged.clear()
        self.limp_requests.clear()
        self.publish_once()

    async def _let_go(self, request: LimpRequest) -> GateReply:
        self.limp_requests.append(request.limp)
        self.limp = request.limp
        return replace(example(GateReply), text="all joints are limp")

    def publish_repeatedly(self) -> None:
        first, *others, last = self.body.joints
        middle = [Joint(name=joint.name, position=0.1) for joint in others]
        measured = (
            Joint(name=first.name, position=0.95993, effort=0.42, temperature=31.4, current=0.2),
            *middle,
            Joint(name=last.name, position=0.01, effort=-0.004),
        )
        here, still = Pose(x=0.0, y=0.0, yaw=0.0), Velocity()
        sent = (0.0, *(joint.position for joint in measured[1:]))
        self.robot.publish(
            STATE,
            RobotState(
                robot_type="so101", pose=here, velocity=still, joints=measured, joints_sent=sent,
                gate=self.gate, limp=self.limp,
            ),
        )  # fmt: skip

    def publish_once(self) -> None:
        self.robot.publish(BODY, Body(description=self.body, link="real"))
        self.robot.publish(ARM_MODEL, ArmModel(mjcf=MODEL))

    @property
    def wanted(self) -> dict[str, float]:
        """The newest commanded speeds."""
        if not self.jogged:
            return {}
        return dict(zip(self.jogged[-1].name, self.jogged[-1].velocity, strict=True))

    async def rests(self) -> None:
        """Wait for zero speeds at the end of the stream."""
        await until(lambda: self.wanted and not any(self.wanted.values()), "zero speeds")


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def fake(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[FakeArm]:
    fake = FakeArm(tmp_path_factory.mktemp("fake"))
    async with serving(fake):
        yield fake


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def started(
    fake: FakeArm, tmp_path_factory: pytest.TempPathFactory
) -> AsyncIterator[Browser]:
    async with browser(fake, tmp_path_factory.mktemp("profile")) as chromium:
        yield chromium


@pytest_asyncio.fixture(loop_scope="module")
async def chromium(started: Browser, fake: FakeArm) -> AsyncIterator[Browser]:
    fake.become()
    yield started
    await started.close_pages()


async def opened(chromium: Browser, token: str | None = None) -> Page:
    page = await chromium.open(token) if token else await chromium.open()
    await page.wait_for_selector("#joints output:has-text('°')")
    return page


async def hold(page: Page, fake: FakeArm, name: str = PAN) -> None:
    """Press a button until its joint moves."""
    await page.get_by_label(name).hover()
    await page.mouse.down()
    await until(lambda: any(fake.wanted.values()), "speeds of joints")


async def test_each_joint_is_shown_in_its_range(chromium: Browser) -> None:
    page = await opened(chromium)
    rows = page.locator("#joints li")
    assert await rows.count() == 6
    first, last = rows.first, rows.last
    assert await first.locator("output").inner_text() == "55.0°"
    assert await first.locator("small").inner_text() == "0.42 N m · 0.20 A · 31 °C"
    assert await last.locator("output").inner_text() == "10.0 mm"
    assert await last.locator("small").inner_text() == "0.00 N"
    meter = first.get_by_role("meter")
    assert await meter.get_attribute("title") == "-110.0° to 110.0°"
    assert await meter.get_attribute("aria-valuetext") == "55.0°"
    left = "(mark, part) => mark.querySelector(part).style.left"
    assert await meter.evaluate(left, "b") == "75%"  # 55 of -110 to 110 degrees
    assert await meter.evaluate(left, "s") == "50%"
    assert await last.get_by_role("meter").evaluate(left, "b") == "25%"
    assert await page.inner_text("#arm-status") == "held"
    tool = ArmKinematics(MODEL, CRANE.joints).forward(np.array([0.95993, 0.1, 0.1, 0.1, 0.1]))
    place = ", ".join(f"{100 * metres:.1f}" for metres in tool.position)
    down = np.degrees(np.arcsin(-tool.axes[2, 0]))
    assert await page.inner_text("#tool-place") == f"tool at {place} cm, {down:.0f}° down"


async def test_an_arm_without_a_base_has_no_map_and_no_joystick(
    chromium: Browser, fake: FakeArm
) -> None:
    page = await opened(chromium)
    await page.wait_for_selector("#world", state="visible")
    for hidden in ("#map", "#stick", ".legend", "#follow", "#edit-zones", "#speed"):
        assert not await page.is_visible(hidden), hidden
    await page.keyboard.down("w")
    await hold(page, fake)
    assert not fake.steered
    await page.mouse.up()
    await page.keyboard.up("w")
    fake.become(DRIVES)
    await page.wait_for_selector("#stick", state="visible")
    assert await page.is_visible("#arm")
    assert await page.is_visible("#edit-zones")


async def test_a_joint_moves_at_the_chosen_speed_while_its_button_is_held(
    chromium: Browser, fake: FakeArm
) -> None:
    page = await opened(chromium)
    await hold(page, fake)
    assert fake.wanted == pytest.approx({"shoulder_pan": 0.6})  # a fifth of 3 rad/s
    await page.wait_for_selector("#arm-status:has-text('shoulder_pan 34.4°/s')")
    await page.mouse.move(5, 5)  # the button stays held when the pointer leaves it
    count = len(fake.jogged)
    await until(lambda: len(fake.jogged) > count + 3, "more speeds")
    await page.mouse.up()
    await fake.rests()
    fake.jogged.clear()
    await page.locator("#jog-share").fill("50")
    await hold(page, fake, "gripper down: hold to move it")
    assert fake.wanted == {"gripper": -1.5}
    await page.mouse.up()
    await fake.rests()


async def test_the_tool_moves_along_an_axis_while_its_button_is_held(
    chromium: Browser, fake: FakeArm
) -> None:
    page = await opened(chromium)
    await hold(page, fake, "tool z up: hold to move it")
    await page.wait_for_selector("#arm-status:has-text('tool z 6 cm/s')")
    posture = np.array([0.95993, 0.1, 0.1, 0.1, 0.1])
    _, jacobian = ArmKinematics(MODEL, CRANE.joints).jacobian(posture)
    speeds = [fake.wanted[joint.name] for joint in CRANE.joints[:-1]]
    assert jacobian[:3] @ speeds == pytest.approx([0.0, 0.0, 0.06], abs=0.01)
    await page.mouse.up()
    await fake.rests()


async def test_the_enter_key_holds_a_button_as_well(chromium: Browser, fake: FakeArm) -> None:
    page = await opened(chromium)
    await page.get_by_label(PAN).focus()
    await page.keyboard.down("Enter")
    await until(lambda: any(fake.wanted.values()), "speeds of joints")
    await page.keyboard.up("Enter")
    await fake.rests()


@pytest.mark.parametrize("end", ["blur", "hidden", "e-stop", "latched", "closed", "cancelled"])
async def test_every_end_of_a_hold_stops_the_joint(
    chromium: Browser, fake: FakeArm, end: str
) -> None:
    page = await opened(chromium)
    await hold(page, fake)
    if end == "blur":
        await page.evaluate("window.dispatchEvent(new Event('blur'))")
    elif end == "hidden":
        await page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    elif end == "e-stop":
        await page.keyboard.press("Space")
        await page.wait_for_selector('#confirmed:has-text("CONFIRMED by")')
    elif end == "latched":
        fake.gate = LATCHED
    elif end == "closed":
        await page.close()
    else:
        await page.get_by_label(PAN).dispatch_event("pointercancel")
    await fake.rests()
    if end == "latched":  # after a release the button must be pressed again
        fake.jogged.clear()
        fake.gate = READY
        await page.wait_for_selector("#gate[data-mode=enabled]")
        await page.wait_for_timeout(400)
        assert not fake.jogged
    if end != "closed":
        await page.mouse.up()


async def test_its_buttons_keep_their_places_when_it_stops(
    chromium: Browser, fake: FakeArm
) -> None:
    page = await opened(chromium)
    button = page.get_by_label(PAN)
    before = await button.bounding_box()
    await page.click("#enable")
    await page.wait_for_selector("#reply:not(:empty)")
    assert await button.bounding_box() == before
    remedy = "check that the commander runs and reaches the robot, then enable it again"
    cause = Cause(code="silence", text="no valid command for 100 ms", remedy=remedy)
    fake.gate = replace(LATCHED, causes=(cause, replace(cause, code="stale", text="old data")))
    await page.wait_for_selector("#causes:has-text('old data')")
    assert await button.bounding_box() == before


async def test_a_limp_arm_is_shown_as_limp(chromium: Browser, fake: FakeArm) -> None:
    fake.gate, fake.limp = LATCHED, True
    page = await opened(chromium)
    await page.wait_for_selector("#arm-status:has-text('limp: the arm may fall')")
    assert "limp" in await page.inner_text("#doing")
    await page.get_by_label(PAN).hover()
    await page.mouse.down()
    await page.wait_for_timeout(400)
    await page.mouse.up()
    assert not fake.jogged


async def test_an_arm_goes_limp_after_a_confirmation_and_is_held_again(
    chromium: Browser, fake: FakeArm
) -> None:
    fake.gate = LATCHED
    page = await opened(chromium)
    assert await page.is_disabled("#arm-hold")
    await page.click("#arm-limp")
    await page.wait_for_selector("#let-go:has-text('may fall')", state="visible")
    await page.keyboard.press("Enter")  # “no” has the focus
    await page.wait_for_selector("#let-go", state="hidden")
    assert not fake.limp_requests
    await page.click("#arm-limp")
    await page.click("#estop")  # it works during the question
    await page.wait_for_selector('#confirmed:has-text("CONFIRMED by")')
    await page.click("#let-go-yes")
    await page.wait_for_selector("#reply:has-text('all joints are limp')")
    await page.wait_for_selector("#arm-status:has-text('“Hold” holds it')")
    assert fake.limp_requests == [True]
    assert await page.is_disabled("#arm-limp")
    await page.click("#arm-hold")
    await page.wait_for_selector("#arm-status:has-text('held')")
    assert fake.limp_requests == [True, False]


async def test_an_enabled_arm_can_be_held_but_not_go_limp(chromium: Browser, fake: FakeArm) -> None:
    page = await opened(chromium)
    assert await page.is_disabled("#arm-limp")
    assert await page.get_attribute("#arm-limp", "title") == "Press STOP first"
    await page.click("#arm-hold")
    await page.wait_for_selector(
        "#reply:has-text('the arm holds until the brain is enabled again')"
    )
    await until(lambda: fake.wanted, "speeds of joints")
    assert fake.wanted == dict.fromkeys((joint.name for joint in CRANE.joints), 0.0)
    assert not fake.limp_requests
    fake.gate = LATCHED
    await page.click("#arm-limp")
    await page.wait_for_selector("#let-go", state="visible")
    fake.gate = READY  # this closes the question
    await page.wait_for_selector("#let-go", state="hidden")


async def test_only_one_of_two_operators_moves_the_arm(chromium: Browser, fake: FakeArm) -> None:
    one, two = await opened(chromium), await opened(chromium)
    await hold(one, fake)
    await two.get_by_label(PAN.replace("up", "down")).focus()
    await two.keyboard.down("Enter")
    await two.wait_for_selector("#reply:has-text('another page steers the robot')")
    await two.keyboard.up("Enter")
    await one.mouse.up()
    await fake.rests()


async def test_a_viewer_sees_joints_without_buttons(chromium: Browser) -> None:
    page = await opened(chromium, VIEWER)
    assert await page.locator("#joints li").count() == 6
    assert not await page.get_by_label(PAN).is_visible()
    assert not await page.is_visible("#jog-share")
    assert not await page.is_visible("#tool")
    assert not await page.is_visible("#arm-hold")
    assert not await page.is_visible("#arm-limp")


async def test_the_arm_is_drawn_in_three_dimensions(chromium: Browser) -> None:
    page = await opened(chromium)
    await page.wait_for_selector("#world", state="visible")
    await drawn(page, lambda r, g, b: (r > 2 * b) & (r > 80), 500)  # yellow


@pytest.mark.slow
async def test_the_path_of_the_tool_and_the_grasps_are_drawn_for_viewers(
    chromium: Browser, fake: FakeArm
) -> None:
    await until(lambda: ARM_PLAN.key not in fake.bus.listens, "no viewer to subscribe")
    page = await opened(chromium)
    await until(lambda: ARM_PLAN.key in fake.bus.listens, "the page to subscribe")
    path = np.linspace((0.1, -0.25, 0.3), (0.25, -0.15, 0.02), 30, dtype="<f4")
    grasps = [
        GraspPose(position=place, orientation=(0.0, 0.7071068, 0.0, 0.7071068), opening=0.03)
        for place in ((0.25, -0.15, 0.02), (0.2, -0.25, 0.02))
    ]
    fake.robot.publish(ARM_PLAN, ArmPlan(path=path.tobytes(), grasps=tuple(grasps)))
    await drawn(page, is_blue, 60)  # the path is blue
    await drawn(page, is_green, 20)  # the chosen grasp is green
    late = await opened(chromium)  # a later viewer gets the kept plan
    await drawn(late, is_blue, 60)
    fake.robot.publish(ARM_PLAN, ArmPlan())
    await drawn(page, is_blue, 0, maximum=0)


def is_blue(r: Colour, g: Colour, b: Colour) -> Any:
    return (b > 2.5 * r) & (b > 1.4 * g)


def is_green(r: Colour, g: Colour, b: Colour) -> Any:
    return (g > 2 * r) & (g > 1.6 * b)


async def drawn(
    page: Page, colour: Callable[..., Any], minimum: int, maximum: int = sys.maxsize
) -> None:
    """Wait until the right number of pixels fulfils `colour`, a condition on r, g and b.

    It uses screenshots, as the canvas itself is empty after the browser has shown it.
    """
    count = -1
    for _ in range(MAX_SCREENSHOTS):
        data = await page.locator("#world").screenshot()
        shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(float)
        b, g, r = np.moveaxis(shown, -1, 0)
        count = np.count_nonzero(colour(r, g, b))
        if minimum <= count <= maximum:
            return
        await asyncio.sleep(0.1)
    raise AssertionError(f"{count} pixels have the colour, not {minimum} to {maximum}")
