"""Watching a body that reports by itself: it is alive or lost, and each change is logged once."""

import logging

import pytest

from gigabrain_drivers.links.link import Liveness
from gigabrain_drivers.links.serial_link import SerialLink
from gigabrain_zenoh.clock import FakeClock

MS = 1_000_000
LOG = logging.getLogger("body")


class Body:
    """A body on an open port that does not exist, with a fake clock."""

    def __init__(self, port: str = "usb:0483:5740") -> None:
        self.clock = FakeClock()
        self.link = SerialLink(port, 115_200, self.clock)
        self.link.problem = ""  # it is open
        self.liveness = Liveness(self.link, self.clock, 100 * MS, "it talks nonsense", LOG)

    async def alive_after(self, milliseconds: int) -> bool:
        await self.clock.advance(milliseconds * MS)
        return self.liveness.alive()


async def test_a_body_is_alive_while_its_newest_message_is_fresh() -> None:
    body = Body()
    assert not await body.alive_after(0)
    assert body.liveness.mark_received()
    assert not body.liveness.mark_received()
    assert await body.alive_after(100)
    assert not await body.alive_after(1)
    assert body.liveness.received
    assert body.liveness.mark_received()  # after a loss
    assert not body.liveness.mark_received()
    body.liveness.reset()
    assert not body.liveness.received


async def test_a_line_that_is_dropped_repeatedly_is_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    body = Body()
    for _ in range(10):
        body.liveness.reset()
        assert not await body.alive_after(200)
    assert [record.message for record in caplog.records] == ["usb:0483:5740: it talks nonsense"]


async def test_a_problem_that_names_the_line_has_no_prefix(
    caplog: pytest.LogCaptureFixture,
) -> None:
    body = Body()
    body.link.problem = "no USB device usb:0483:5740: is it plugged in?"
    await body.alive_after(501)
    assert caplog.messages == ["no USB device usb:0483:5740: is it plugged in?"]


async def test_the_end_of_a_silence_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    body = Body("/dev/ttyUSB9")
    await body.alive_after(501)
    body.liveness.mark_received()
    assert body.liveness.alive()
    assert caplog.messages == ["/dev/ttyUSB9: it talks nonsense", "/dev/ttyUSB9: reports again"]
