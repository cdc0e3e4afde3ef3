"""Gaps of Nav2's collision monitor (a to k), one test for each. Docstrings tell what Nav2 does."""

import math

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription, Thresholds
from gigabrain_schemas.topics import (
    ARM_MODEL,
    CMD_VEL,
    HEALTH,
    IMAGE,
    IMU,
    INTENT,
    JOINT_CMD,
    LOG,
    MAP,
    POSE,
    SAFETY,
    SCAN,
    SERVICES,
    STATE,
    WORLD,
)
from gigabrain_schemas.topics import BODY as BODY_TOPIC
from gigabrain_zenoh.gate import gate
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.safety.step import SafetyInputs, step
from gigabrain_zenoh.testing.in_memory import NodeBench
from gigabrain_zenoh.testing.samples import body, open_space, scan, state
from tests.unit.gate.rig import driving
from tests.unit.safety.patrol import BODY, Patrol

MONITORED = (
    ARM_MODEL, BODY_TOPIC, STATE, SCAN, CMD_VEL, JOINT_CMD, IMU, IMAGE, POSE, MAP, HEALTH, LOG,
    WORLD, INTENT,
)  # fmt: skip
AHEAD = Velocity(linear_x=0.2)


async def test_a_it_judges_without_any_command() -> None:
    """In Nav2 only a command triggers it: a dead commander leaves the body as it is."""
    async with NodeBench(safety.run) as bench:
        bench.send(BODY_TOPIC, body())
        for tick in range(1, 41):
            bench.send(STATE, state(tick, v=0.2))
            if tick % 5 == 0:
                bench.send(SCAN, scan(open_space(deg_0=0.2), tick))
        verdicts = bench.sent(SAFETY)
    assert len(verdicts) >= 20
    assert verdicts[-1].caps.forward == 0.0
    assert "control_silent" in [cause.code for cause in verdicts[-1].causes]


def test_b_a_command_that_is_not_a_number_is_zero_at_once() -> None:
    """In Nav2 it is ignored, and the body keeps the last command."""
    rig = driving(0.2)
    rig.feed(gate.NotFinite("control", rig.state.boot))
    rig.tick()
    assert rig.state.output == Velocity()


async def test_c_a_scan_stamped_in_the_future_goes_stale() -> None:
    """In Nav2 it never does."""
    async with NodeBench(safety.run) as bench:
        bench.send(BODY_TOPIC, body())
        for tick in range(1, 41):
            bench.send(STATE, state(tick))
            if tick in (5, 10):
                bench.send(SCAN, replace(scan(open_space(), tick), stamp_ns=9 * 10**18))
        verdicts = bench.sent(SAFETY)
    lost = [v.tick for v in verdicts if v.tick > 10 and v.causes[0].code == "scan_lost"]
    assert min(lost) == 23  # 260 ms after the last


def test_c_scans_with_future_ticks_do_not_hide_that_valid_ones_are_missing() -> None:
    memory, found = Patrol().memory, []  # with the scans of ticks 5 and 10
    for tick in range(11, 41):
        future = scan(open_space(), tick + 1000)
        inputs = SafetyInputs(state=state(tick), scan=future, scan_age_ns=0)
        memory, verdict = step(BODY, memory, inputs)
        found.append((tick, [cause.code for cause in verdict.causes]))
    assert [tick for tick, causes in found if "scan_lost" in causes] == list(range(23, 41))
    assert verdict.causes[0].text == (
        "no scan for more than 250 ms; the newest has the future tick 1040 at tick 40"
    )


@pytest.mark.parametrize("value", [math.nan, 0.0, 1e9, -1.0, -math.inf])
def test_d_a_blind_lidar_is_not_free_space(value: float) -> None:
    """In Nav2 impossible values are dropped, and the rest is free."""
    patrol = Patrol()
    assert patrol.go(5, values=np.full(360, value)) == ["scan_blind"]
    assert patrol.verdict.verdict == "stop"


def test_e_the_zone_goes_by_the_measured_speed_while_coasting() -> None:
    """In Nav2 the commanded speed selects it: 0 takes the smallest."""
    patrol = Patrol()
    patrol.go(60, commanded=AHEAD)
    patrol.go(10, moves=AHEAD)
    assert patrol.go(5, moves=AHEAD, values=open_space(deg_0=0.22)) == ["zone_ahead"]


def test_f_there_is_no_speed_without_a_zone() -> None:
    """In Nav2 a speed outside all ranges keeps the previous polygon."""
    forward = brakes(BODY)["forward"]
    assert forward.distance(0.26) == pytest.approx(0.197, abs=0.001)
    assert forward.distance(5.0) == pytest.approx(14.18)
    patrol = Patrol()
    patrol.go(5, moves=Velocity(linear_x=1.0))
    found = patrol.go(5, moves=Velocity(linear_x=1.0), values=open_space(deg_0=0.9))
    assert "zone_ahead" in found


@pytest.mark.parametrize(
    "name",
    [
        "scan_age", "heartbeat", "reaction_time", "stop_margin", "resume_margin", "round_trip",
        "missing_after", "battery_stop", "tilt_stop", "shock_stop", "follow_linear",
        "follow_angular", "follow_sustain", "stuck_sustain", "frozen_sustain",
    ],
)  # fmt: skip
def test_g_no_check_can_be_switched_off_by_a_zero(name: str) -> None:
    """In Nav2 a source_timeout of 0 removes the check."""
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({name: 0.0}, Thresholds)


async def test_h_nobody_can_switch_it_off() -> None:
    """In Nav2 any caller can toggle it, and move its zones, by services."""
    async with NodeBench(safety.run) as bench:
        bench.send(BODY_TOPIC, body())
        stranger = bench.network.transport()
        answers = [
            await stranger.query(service.at("safety"), b"", "", 0.1, "data") for service in SERVICES
        ]
        received = set(bench.bus.listens)
    assert answers == [[]] * len(SERVICES)
    assert received == {topic.at("*") for topic in MONITORED}  # measurements, but no requests


@pytest.mark.parametrize("degrees", range(-20, 21, 5))
def test_i_one_beam_on_a_chair_leg_is_enough(degrees: int) -> None:
    """Nav2 wants four to six points: a leg of 2 cm returns one or two."""
    patrol = Patrol()
    patrol.go(60, commanded=AHEAD)
    values = open_space(**{f"deg_{degrees % 360}": 0.2})
    assert patrol.go(5, commanded=AHEAD, values=values) == ["zone_ahead"]


def test_j_stop_is_published_for_as_long_as_it_holds() -> None:
    """Nav2 sends no zeros any more after a second or two."""
    patrol = Patrol()
    for _ in range(100):
        patrol.go(25, values=np.full(360, np.nan))
        assert patrol.codes == ["scan_blind"]
    rig = driving(0.2)
    for _ in range(3000):
        rig.tick()
        assert rig.state.output.linear_x <= 0.2
    assert (rig.mode, rig.state.output) == ("idle", Velocity())


@pytest.mark.parametrize(
    "footprint", [[], [[0.1, 0.1]], [[0, 0], [1, 0], [2, 0]], [[0, 0], [0, 0], [0, 0]]]
)
def test_k_a_footprint_that_encloses_nothing_is_refused(footprint: list[list[float]]) -> None:
    """In Nav2 an empty footprint skips the zone."""
    file = {
        "summary": "x",
        "robot_type": "x",
        "drive_type": "differential",
        "footprint": footprint,
        "max_linear_speed": 0.2,
        "max_angular_speed": 1.0,
    }
    with pytest.raises(msgspec.ValidationError, match="footprint"):
        msgspec.convert(file, RobotFile)


def test_a_body_that_cannot_stop_within_its_lidars_range_is_refused() -> None:
    whole = msgspec.to_builtins(BODY)
    with pytest.raises(msgspec.ValidationError, match=r"takes 14\.18 m to stop"):
        msgspec.convert({**whole, "max_linear_speed": 5.0}, BodyDescription)


@pytest.mark.parametrize("name", ["follow_linear", "follow_angular"])
def test_a_tolerance_that_hides_a_runaway_is_refused(name: str) -> None:
    whole = msgspec.to_builtins(BODY)
    with pytest.raises(
        msgspec.ValidationError, match=rf"thresholds: {name}: its error never reaches"
    ):
        msgspec.convert({**whole, "thresholds": {name: 100.0}}, BodyDescription)


@pytest.mark.parametrize(
    "wrong",
    [
        {"battery_stop": 20.0},
        {"battery_return": 16.0},
        {"battery_return": 4.0},
        {"motor_stop": 50.0},
        {"battery_sustain": -1.0},
        {"tilt_stop": 91.0},
        {"tilt_stop": 0.5},  # radians
        {"battery_stop": 0.07},  # a fraction
        {"motor_stop": 1000.0},
        {"shock_stop": 1e9},
        {"heartbeat": 0.0001},
        {"scan_age": 60.0},
        {"reaction_time": 0.0001},
        {"stop_margin": 0.0001},
        {"resume_margin": 1e-5},
    ],
)
def test_thresholds_that_contradict_one_another_or_switch_a_monitor_off_are_refused(
    wrong: dict[str, float],
) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, Thresholds)
