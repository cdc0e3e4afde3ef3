"""`gigabrain bench joints`: tracking errors of each joint of an arm, on a sine and a step.

The arm is in the posture with the largest gravity efforts, and carries a load. Control and gate are
the same as on a robot; they run in memory on a simulated body. The physics give true positions.
"""

import dataclasses
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
from msgspec import Struct

from gigabrain_drivers.driver.catalog import load_link
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import MujocoOptions, SimModel, sim_body
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S
from gigabrain_schemas.brain import Intent, JointTarget, JointTrajectory
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.manipulation.arm_kinematics import ArmKinematics
from gigabrain_zenoh.manipulation.collision import CollisionChecker
from gigabrain_zenoh.manipulation.inverse_kinematics import spread
from gigabrain_zenoh.qa.bench.hands import ArmInMemory, with_backlash

SINE_HZ, PERIODS, SKIPPED = 0.5, 5, 1  # periods in total, and at the start without measurement
SPEED_SHARE = 0.5  # of the joint's top speed, at the middle of the sine
SPARE_RAD = 0.03  # between the sine and the ends of the joint's range
WINDOW_TICKS = 100  # length of a trajectory in an intent, like decision's
SETTLE_TICKS = 150  # 3 s
POSTURES = 3000  # candidates for the stretched posture
LOW_FLOOR = """<mujoco><worldbody>
  <geom name="floor" type="plane" size="2 2 .1" pos="0 0 -2"/></worldbody></mujoco>"""
LOAD = {"type": "sphere", "size": "0.015", "contype": "0", "conaffinity": "0", "group": "2"}
Progress = Callable[[str], None]


class JointTracking(Struct, frozen=True, kw_only=True):
    """The true errors of one joint that follows a sine and a step."""

    joint: str
    amplitude_deg: float  # of the sine
    rms_deg: float  # error on the sine
    worst_deg: float
    lag_ms: float  # delay behind the sine
    overshoot: float  # share of the step
    rest_deg: float  # error at rest, after the step


class TrackingResult(Struct, frozen=True, kw_only=True):
    """The errors of all joints of an arm."""

    body: str
    load_kg: float
    backlash_deg: float
    joints: tuple[JointTracking, ...]


def measure_joints(
    body: str, load_kg: float, backlash_deg: float, show: Progress
) -> TrackingResult:
    """Let each joint of an arm follow a sine and a step. Raises ConfigError without an arm."""
    robot, _, options, folder = load_link(body, Run(folder=Path()))
    if robot.arm is None or not isinstance(options, MujocoOptions):
        raise ConfigError(f"{body} has no arm in MuJoCo; choose so101 or piper")
    model = sim_body(robot, options, Run(folder=folder))
    model = with_backlash(loaded(model, robot.arm.tool, load_kg), math.radians(backlash_deg))
    kinematics = ArmKinematics(model.model, robot.joints, robot.arm.tool)
    posture = stretched(kinematics)
    found = []
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as empty:
        (Path(empty) / "empty.xml").write_text(LOW_FLOOR)
        world = Path(empty) / "world.yaml"
        world.write_text("model: empty.xml\nstart: [0.0, 0.0, 0.0]\n")
        for number, joint in enumerate(kinematics.joints):
            trial = Trial(ArmInMemory(robot, model, world), kinematics, posture, number)
            found.append(trial.run())
            show(f"{joint.name}: {found[-1].rms_deg:.2f}° rms, overshoot {found[-1].overshoot:.1%}")
    return TrackingResult(
        body=body, load_kg=load_kg, backlash_deg=backlash_deg, joints=tuple(found)
    )


def loaded(model: SimModel, tool: str, load_kg: float) -> SimModel:
    """Return a body with a load at its tool; the load has no contacts."""
    if not load_kg:
        return model
    root = xml.fromstring(model.model)
    parent = root.find(f".//site[@name='{tool}']/..")
    site = root.find(f".//site[@name='{tool}']")
    assert parent is not None
    assert site is not None
    load = xml.SubElement(parent, "body", name="load", pos=site.get("pos", "0 0 0"))
    xml.SubElement(load, "geom", LOAD, mass=f"{load_kg:g}")
    return dataclasses.replace(model, model=xml.tostring(root, "unicode"))


def amplitudes(arm: ArmKinematics) -> Floats:
    """Return the amplitude (n,) [rad] at which each joint reaches half its top speed."""
    speeds = np.array([SPEED_SHARE * joint.max_speed for joint in arm.joints])
    return np.asarray(speeds / (math.tau * SINE_HZ))


def stretched(arm: ArmKinematics) -> Floats:
    """Return the posture (n,) with the largest gravity efforts in which each joint can swing.

    Raises ConfigError if there is none.
    """
    swings = amplitudes(arm)
    low, high = arm.lower + swings + SPARE_RAD, arm.upper - swings - SPARE_RAD
    if np.any(low > high):
        raise ConfigError("a joint's range is too small for half of its greatest speed")
    postures = low + spread(POSTURES, len(low)) * (high - low)
    heavy = [float(np.abs(arm.weights(posture)).sum()) for posture in postures]
    checker = CollisionChecker(arm, margin=0.001)
    for number in np.argsort(heavy)[::-1]:
        posture = np.asarray(postures[number])
        ends = [posture + way * row for row in np.diag(swings) for way in (-1.0, 1.0)]
        if all(checker.is_line_free(ends[k], ends[k + 1]) for k in range(0, len(ends), 2)):
            return posture
    raise ConfigError("there is no posture in which each joint may swing")


class Trial:
    """One joint of an arm moves, while the others hold their positions."""

    def __init__(
        self, arm: ArmInMemory, kinematics: ArmKinematics, posture: Floats, number: int
    ) -> None:
        self._arm, self._kinematics = arm, kinematics
        self._posture, self._number = posture, number
        self._name = kinematics.names[number]
        self._swing = float(amplitudes(kinematics)[number])

    def run(self) -> JointTracking:
        """Measure a sine, and a step between its extremes."""
        low, high = (float(self._posture[self._number]) + way * self._swing for way in (-1.0, 1.0))
        self._go_to(low)
        wanted, measured = self._sine(low)
        error_deg = np.degrees(measured - wanted)
        self._go_to(low)
        step = np.array(list(self._step_response(high)))
        return JointTracking(
            joint=self._name,
            amplitude_deg=math.degrees(self._swing),
            rms_deg=float(np.sqrt((error_deg**2).mean())),
            worst_deg=float(np.abs(error_deg).max()),
            lag_ms=_lag_s(wanted, measured) * 1000,
            overshoot=max(0.0, float(step.max() - high) / (high - low)),
            rest_deg=math.degrees(abs(float(step[-1]) - high)),
        )

    def _true_position(self) -> float:
        places = dict(zip(self._arm.arm.names, self._arm.arm.truth()[0], strict=True))
        return places[self._name]

    def _go_to(self, place: float) -> None:
        """Bring the arm to rest in its posture, with the joint at `place` [rad]."""
        wanted = self._posture_with(place)
        before = self._arm.posture(self._kinematics.names)
        for share in np.linspace(0.0, 1.0, SETTLE_TICKS):
            self._step_to(self._by_name(before + share * (wanted - before)))
        for _ in range(SETTLE_TICKS):
            self._step_to(self._by_name(wanted))

    def _step_response(self, place: float) -> Iterator[float]:
        """Yield the joint's true position [rad] while it steps to `place` at full speed."""
        wanted = self._by_name(self._posture_with(place))
        for _ in range(SETTLE_TICKS):
            self._step_to(wanted)
            yield self._true_position()

    def _sine(self, low: float) -> tuple[Floats, Floats]:
        """Return the wanted and the true positions [rad], in the periods that count."""
        period = round(1 / (SINE_HZ * TICK_S))
        angles = np.arange(PERIODS * period + WINDOW_TICKS) * math.tau / period
        way = low + self._swing * (1.0 - np.cos(angles))
        measured = []
        first = self._arm.state().tick + 1  # tick of the next step's first state
        for tick in range(PERIODS * period):
            window = JointTrajectory(
                name=(self._name,), start=first + tick, period=TICK_S,
                positions=way[tick : tick + WINDOW_TICKS].astype("<f4").tobytes(),
            )  # fmt: skip
            measured.append(self._true_position())
            self._arm.step(Intent(joint_trajectory=window, behaviour="sine", reason="sine"))
        counted = slice(SKIPPED * period, PERIODS * period)
        return way[counted], np.array(measured)[counted]

    def _posture_with(self, place: float) -> Floats:
        posture = self._posture.copy()
        posture[self._number] = place
        return posture

    def _by_name(self, posture: Floats) -> Mapping[str, float]:
        return dict(zip(self._kinematics.names, posture.tolist(), strict=True))

    def _step_to(self, places: Mapping[str, float]) -> None:
        targets = tuple(JointTarget(name=name, position=place) for name, place in places.items())
        self._arm.step(Intent(joints=targets, behaviour="step", reason="step"))


def _lag_s(wanted: Floats, measured: Floats) -> float:
    """Return the delay of a measured sine behind the wanted one [s]."""
    angles = np.arange(len(wanted)) * TICK_S * math.tau * SINE_HZ
    turns = np.exp(-1j * angles)
    phase = np.angle((measured * turns).sum() / (wanted * turns).sum())
    return float(-phase / (math.tau * SINE_HZ))
