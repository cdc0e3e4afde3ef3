from typing import Any

import pytest

from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.lidars.rplidar.emulator import RplidarDevice
from gigabrain_drivers.lidars.rplidar.protocol import EXPRESS, STANDARD, Info, RplidarDecoder
from gigabrain_drivers.lidars.rplidar.source import (
    RplidarOptions,
    StartupError,
    choose_mode,
)
from tests.system.lidars import Wire, run_for, waffle


def decoded(model: Any, request: bytes, seconds: float) -> tuple[bytes, RplidarDecoder, int]:
    body, wire = waffle(), Wire()
    device = RplidarDevice(body, RplidarOptions(driver="rplidar", model=model), wire)
    device.reset()
    wire.sent.clear()
    device.feed(request)
    run_for(body, device, seconds)
    decoder = RplidarDecoder()
    found = decoder.feed(b"".join(wire.sent))
    return wire.sent[0], decoder, len(found)


@pytest.mark.parametrize(
    ("model", "request_bytes", "descriptor", "blocks"),
    [
        ("a1", rplidar.request(rplidar.SCAN), "a55a0500004081", 2000),
        ("a1", rplidar.express_request(), "a55a5400004082", 4000 // 32 - 1),
        ("c1", rplidar.express_request(1), "a55a5400004085", 5000 // 40 - 1),
        ("s2", rplidar.express_request(1), "a55a5400004085", 32000 // 40 - 1),
    ],
)
def test_the_emulator_streams_at_its_models_rate(
    model: str, request_bytes: bytes, descriptor: str, blocks: int
) -> None:
    """One capsule is missing, because a capsule is decoded with the next one."""
    first, decoder, found = decoded(model, request_bytes, 1.0)

    assert first == bytes.fromhex(descriptor)
    assert (found, decoder.errors) == (blocks, 0)


def test_an_a2_turns_after_a_command_to_its_board_and_an_s2_stops_at_speed_zero() -> None:
    assert decoded("a2m8", rplidar.request(rplidar.SCAN), 0.2)[2] == 0
    pwm = rplidar.request(rplidar.SET_PWM, (660).to_bytes(2, "little"))
    assert decoded("a2m8", rplidar.request(rplidar.SCAN) + pwm, 0.2)[2] == 400
    stop = rplidar.request(rplidar.SET_SPEED, bytes(2))
    assert decoded("s2", stop + rplidar.request(rplidar.SCAN), 0.2)[2] == 0


class Scripted:
    """A lidar with the given scan modes: answer type, and microseconds per sample."""

    def __init__(self, typical: int, modes: list[tuple[int, int]]) -> None:
        self._typical, self._modes = typical, modes

    def send(self, data: bytes) -> None: ...

    def motor(self, *, on: bool) -> None: ...

    def identified(self, info: Info, *, pwm: bool) -> None: ...

    async def ask(self, request: bytes, kind: int) -> bytes:
        key, mode = request[3], int.from_bytes(request[7:9], "little")
        values = {
            rplidar.MODE_TYPICAL: self._typical.to_bytes(2, "little"),
            rplidar.MODE_COUNT: len(self._modes).to_bytes(2, "little"),
            rplidar.MODE_ANSWER: bytes([self._modes[mode][0]]) if mode < len(self._modes) else b"",
            rplidar.MODE_MICROSECONDS: (self._modes[mode % 2][1] * 256).to_bytes(4, "little"),
        }
        return request[3:7] + values[key]


A1_MODES = [(0x81, 500), (0x82, 250), (0x84, 125), (0x84, 125)]  # as a real A1 lists them


@pytest.mark.parametrize(
    ("firmware", "model", "scan_mode", "expected"),
    [
        ((1, 29), 0x18, "auto", (EXPRESS, 1)),  # its typical mode, 84, is not supported
        ((1, 29), 0x18, "standard", (STANDARD, 0)),
        ((1, 20), 0x18, "auto", (EXPRESS, 0)),  # too old to report its modes
        ((1, 15), 0x18, "auto", (STANDARD, 0)),  # too old for express
        ((1, 1), 0x41, "auto", (EXPRESS, 1)),  # every C1 reports its modes
    ],
)
async def test_the_scan_mode_is_supported_by_lidar_and_source(
    firmware: tuple[int, int], model: int, scan_mode: str, expected: tuple[int, int]
) -> None:
    info = Info(model, firmware, 7, "00" * 16)

    assert await choose_mode(Scripted(2, A1_MODES), info, scan_mode) == expected


@pytest.mark.parametrize("firmware", [(1, 29), (1, 20)])
async def test_a_scan_mode_that_the_lidar_lacks_is_refused(firmware: tuple[int, int]) -> None:
    info = Info(0x18, firmware, 7, "00" * 16)

    with pytest.raises(StartupError, match="no scan_mode 'dense'"):
        await choose_mode(Scripted(2, A1_MODES), info, "dense")
