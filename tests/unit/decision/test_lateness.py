"""Latency from scans to intents, in ticks of the robot."""

from gigabrain_zenoh.decision.context import ScanLatency

BOOT = 7


def answered(late: ScanLatency, basis: int, begun: int, done: int) -> float:
    """Process a scan of tick `basis` from `begun` until just before `done`."""
    late.observe_state(BOOT, begun)
    late.begin(begun, basis)
    late.observe_state(BOOT, begun)  # the same state again is ignored
    late.observe_state(BOOT, done)
    return late.excess_s


def test_an_answer_within_two_ticks_is_in_time() -> None:
    late = ScanLatency()
    assert late.excess_s == 0.0
    assert answered(late, basis=10, begun=10, done=11) == 0.0
    assert answered(late, basis=20, begun=21, done=23) == 0.0


def test_late_scans_and_slow_steps_count_alike() -> None:
    assert answered(ScanLatency(), basis=10, begun=15, done=16) == 0.06
    assert answered(ScanLatency(), basis=10, begun=10, done=16) == 0.06


def test_the_slowest_of_the_last_two_seconds_counts() -> None:
    late = ScanLatency()
    assert answered(late, basis=10, begun=10, done=16) == 0.06
    assert answered(late, basis=20, begun=20, done=21) == 0.06
    assert answered(late, basis=111, begun=111, done=116) == 0.06
    assert answered(late, basis=117, begun=117, done=118) == 0.04
    late.observe_state(BOOT, 217)
    assert late.excess_s == 0.0


def test_a_restart_of_the_driver_resets_the_latency() -> None:
    late = ScanLatency()
    assert answered(late, basis=10, begun=10, done=16) == 0.06
    late.begin(20, 20)
    late.observe_state(BOOT + 1, 90)
    assert late.excess_s == 0.0
