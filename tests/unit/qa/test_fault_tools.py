"""Tools with which the fault suite breaks a robot."""

import time

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN, STATE
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.qa.faults.broken_process import (
    TamperingSteps,
    jumps,
    other_host,
    skewed_clocks,
    tampering_bus,
)
from gigabrain_zenoh.qa.faults.rows.sensors import nothing
from gigabrain_zenoh.qa.simulated_drives import SafetyTrack

SECOND_NS = 1_000_000_000


def test_a_wall_clock_that_jumps_does_so_by_hours_and_years_and_goes_back() -> None:
    offsets_h = [round(jumps(round(s * SECOND_NS)) / 3.6e12) for s in (0, 1.5, 3, 4, 6)]
    assert offsets_h == [0, 1, -1, 87660, -87660]
    assert jumps(7_000_000_000) == -3_500_000_000


def test_the_other_host_is_five_seconds_ahead_and_gains_200_ppm() -> None:
    assert other_host(0) == 5_000_000_000
    assert other_host(10 * SECOND_NS) == 5_002_000_000


def test_python_s_clocks_are_wrong_while_they_are_skewed_and_right_again_after() -> None:
    true_ns, true_s = time.monotonic_ns(), time.time()
    with skewed_clocks(lambda _: 10 * SECOND_NS, lambda _: 5 * SECOND_NS):
        assert time.time() - true_s >= 10
        assert time.monotonic_ns() - true_ns >= 5 * SECOND_NS
    assert time.monotonic_ns() - true_ns < 5 * SECOND_NS


async def test_a_tampering_process_spoils_what_it_should_from_one_signal_to_the_next() -> None:
    network, steps = LocalNetwork(), TamperingSteps("nan,crooked")
    bus = tampering_bus(steps, network.transport(), FakeClock(), "driver")
    scan, state = EXAMPLES["LaserScan"], EXAMPLES["RobotState"]
    for _ in range(4):
        bus.publish(SCAN, replace(scan))
        bus.publish(STATE, state)
        steps.count += 1
    scans = [payload for key, payload in network.sent if key == SCAN.key]
    states = [payload for key, payload in network.sent if key == STATE.key]
    decode = codec.Codec(LaserScan, SCAN.max_bytes).decode
    assert np.isfinite(decode(scans[0]).ranges_m).any()
    assert np.isnan(decode(scans[1]).ranges_m).all()
    assert np.isfinite(decode(scans[2]).ranges_m).any()
    with pytest.raises(ValueError, match="angle_increment must not be 0"):
        decode(scans[3])
    assert {msgspec.msgpack.decode(payload)["robot_type"] for payload in states} == {
        state.robot_type  # type: ignore[attr-defined]
    }


@pytest.mark.long
def test_on_the_track_only_safety_keeps_a_blind_driver_from_a_post() -> None:
    post = ((0.6, 0.0, 0.035),)
    seen, unseen = (SafetyTrack("turtlebot3_waffle", 4, 4, post) for _ in range(2))
    unseen.sees = nothing
    for track in (seen, unseen):
        track.run(150, 0.26)
    assert seen.simulation.truth.contacts == 0
    assert seen.output.linear_x == 0.0
    assert unseen.simulation.truth.contacts == 1
