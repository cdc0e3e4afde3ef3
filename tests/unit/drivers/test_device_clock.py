"""Delay of a device's data, from its own stamps or from echoes, on a fake clock."""

import random
from collections.abc import Callable

import pytest

from gigabrain_drivers.links.device_clock import DeviceClock, EchoClock

MS = 1_000_000
WRAP = 30_000


class Line:
    """A device that stamps its frames, on a line with a delay."""

    def __init__(
        self, period_ms: float = 10.0, rate: float = 1.0, wrap_ms: int = WRAP, begin_ms: float = 7.0
    ) -> None:
        self.clock = DeviceClock(wrap_ms)
        self.period_ms, self.rate, self.wrap_ms, self.begin_ms = period_ms, rate, wrap_ms, begin_ms
        self.sent_ms = 100_000.0  # on the host's clock
        self.received_ms = 0.0

    def run(self, seconds: float, delay: Callable[[], float] = lambda: 3.0) -> list[float]:
        """Send frames for some seconds; return the measured delay after each [ms]."""
        delays = []
        for _ in range(round(seconds * 1e3 / self.period_ms)):
            self.sent_ms += self.period_ms
            self.received_ms = max(self.received_ms, self.sent_ms + delay())  # in order
            stamp = int(self.begin_ms + (self.sent_ms - 100_000.0) * self.rate) % self.wrap_ms
            self.clock.arrived(stamp, round(self.received_ms * MS))
            delays.append(self.clock.late_ms)
        return delays

    def pause(self, seconds: float) -> None:
        self.sent_ms += seconds * 1e3


def late(ms: float) -> Callable[[], float]:
    return lambda: 3.0 + ms


def test_a_delay_of_100_ms_is_measured_within_half_a_second() -> None:
    line = Line()
    assert max(line.run(10.0)) <= 1.0
    delays = line.run(2.0, late(100.0))
    assert next(i for i, ms in enumerate(delays) if ms > 70.0) * 10.0 <= 500.0
    assert delays[-1] == pytest.approx(100.0, abs=5.0)


@pytest.mark.long
def test_a_long_delay_is_measured_until_it_ends() -> None:
    line = Line()
    line.run(120.0)
    assert min(line.run(600.0, late(100.0))[100:]) > 90.0
    assert max(line.run(60.0)[100:]) <= 10.0


@pytest.mark.long
@pytest.mark.parametrize("max_ms", [20.0, 40.0])
def test_jitter_is_no_delay(max_ms: float) -> None:
    chance, line = random.Random(1), Line()
    assert max(line.run(300.0, lambda: chance.uniform(0.0, max_ms))) < 40.0


def test_a_pause_of_the_host_is_no_delay() -> None:
    line = Line()
    line.run(10.0)
    for _ in range(20):
        waiting = iter(range(250, 0, -10))  # data that waited in the port arrive together
        assert max(line.run(0.25, lambda: float(next(waiting)))) < 30.0  # noqa: B023
        assert max(line.run(1.0)) < 30.0


@pytest.mark.long
@pytest.mark.parametrize("rate", [0.995, 0.9999, 1.0001, 1.005])
def test_clock_drift_is_no_delay_and_hides_none(rate: float) -> None:
    line = Line(rate=rate)
    assert max(line.run(120.0)) < 10.0
    assert min(line.run(60.0, late(100.0))[100:]) > 80.0
    assert max(line.run(60.0)[100:]) < 20.0


def test_the_wrap_of_the_stamp_is_no_delay() -> None:
    for begin_ms in (0.0, 29_990.0):
        line = Line(begin_ms=begin_ms)
        assert max(line.run(95.0)) <= 1.0
        assert min(line.run(95.0, late(100.0))[100:]) > 80.0


def test_after_a_restart_of_the_device_its_delay_is_zero() -> None:
    for restarted_at in (0.0, 12_000.0):
        line = Line(begin_ms=20_000.0)
        line.run(9.5)  # its stamp is 29.5 s
        line.pause(3.0)
        line.begin_ms = restarted_at - (line.sent_ms - 100_000.0)
        assert max(line.run(20.0)) < 5.0
        assert min(line.run(5.0, late(100.0))[100:]) > 80.0


def test_a_damaged_stamp_changes_nothing() -> None:
    line = Line()
    line.run(10.0)
    for stamp in (0, 9_000, 10_300, 29_999):
        line.clock.arrived(stamp, round(line.received_ms * MS))
        assert max(line.run(1.0)) <= 1.0
    assert min(line.run(2.0, late(100.0))[100:]) > 80.0


def test_after_a_long_silence_or_a_new_connection_the_delay_is_zero() -> None:
    line = Line()
    line.run(10.0)
    line.run(2.0, late(100.0))
    line.clock.clear()
    assert max(line.run(5.0, late(100.0))) <= 1.0
    line.pause(16.0)
    assert max(line.run(5.0, late(300.0))) <= 1.0


def test_a_delay_from_the_first_byte_on_is_not_measured_from_stamps() -> None:
    assert max(Line().run(60.0, late(100.0))) <= 1.0


def test_echoes_show_a_delay_from_the_start() -> None:
    for delay_ms, late_ms in ((20, 0.0), (60, 0.0), (130, 100.0)):
        clock = EchoClock(usual_ms=30.0)
        for ms in range(0, 2000, 10):
            if ms % 20 == 0:
                clock.sent(ms, ms * MS)
            echo = ms - delay_ms - (ms - delay_ms) % 20
            jitter = 35 if ms % 100 == 0 else 0  # the fastest echoes count
            clock.echoed(echo - 20 * bool(jitter), (ms + jitter) * MS)
        assert clock.late_ms == pytest.approx(late_ms, abs=31.0)
        assert (clock.late_ms > 70.0) == (late_ms > 70.0)


def test_repeated_and_unknown_echoes_are_ignored() -> None:
    clock = EchoClock(usual_ms=30.0)
    for ms in range(0, 2000, 10):
        clock.sent(ms, ms * MS)
        clock.echoed(ms, (ms + 20) * MS)
        clock.echoed(ms, (ms + 500) * MS)
        clock.echoed(99_999, (ms + 500) * MS)
    assert clock.late_ms == 0.0
