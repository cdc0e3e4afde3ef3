import asyncio
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gigabrain_drivers.emulators.faults import NONE, Faults
from gigabrain_drivers.emulators.ld import LdDevice
from gigabrain_drivers.emulators.rplidar import RplidarDevice
from gigabrain_drivers.lidars.rplidar import Rplidar, RplidarOptions
from gigabrain_drivers.lidars.rplidar_start import Trouble, choose
from gigabrain_drivers.protocols import rplidar
from gigabrain_drivers.protocols.rplidar import DENSE, EXPRESS, STANDARD, Decoder, Health, Info
from gigabrain_schemas.arrays import ranges
from gigabrain_zenoh.clock import Clock
from tests.lidar_rig import LIDAR, Listener, Wire, agree, emulated, run_for, truth, until, waffle


def options(folder: Path, **settings: Any) -> RplidarOptions:
    return RplidarOptions(driver="rplidar", port=str(folder / "scan"), **settings)


def listen(its: RplidarOptions) -> Listener:
    return Listener(Rplidar(its, LIDAR, Clock()))


@pytest.mark.parametrize(
    ("model", "scan_mode", "kind"),
    [
        ("a1", "standard", STANDARD),
        ("a1", "auto", EXPRESS),
        ("a2m8", "auto", EXPRESS),  # whose motor an accessory board powers
        ("c1", "auto", DENSE),
        ("s2", "auto", DENSE),  # whose speed is commanded
        ("s2", "standard", STANDARD),
    ],
)
async def test_a_scan_of_each_model_is_the_scan_of_the_simulation(
    model: Any, scan_mode: Any, kind: int, tmp_path: Path
) -> None:
    its = options(tmp_path, model=model, scan_mode=scan_mode)
    async with emulated(RplidarDevice, its) as station, listen(its) as listener:
        scan = (await listener.more(2))[-1]
        device = station.device

        assert isinstance(device, RplidarDevice)
        assert device._mode is not None
        assert device._mode.kind == kind
        missing = int(np.isnan(ranges(scan)).sum())
        assert missing <= (165 if kind == STANDARD and model == "a1" else 0)  # 200 samples a turn
        assert agree(scan, truth()) > 0.97 - missing / 360
        assert listener.source.health.connected
        assert listener.source.health.errors == 0


async def test_a_lidar_that_was_rebooted_is_started_again(tmp_path: Path) -> None:
    its = options(tmp_path, model="c1")
    async with emulated(RplidarDevice, its) as station, listen(its) as listener:
        await listener.more(1)
        station.set(Faults(reboot=True))
        await asyncio.sleep(0.1)
        station.set(NONE)
        assert isinstance(station.device, RplidarDevice)
        assert station.device._mode is None

        await listener.more(2)


async def test_a_lidar_that_was_unplugged_is_started_again(tmp_path: Path) -> None:
    its = options(tmp_path, model="c1")
    async with emulated(RplidarDevice, its) as station, listen(its) as listener:
        await listener.more(1)
        station.set(Faults(unplugged=True))
        await until(lambda: not listener.source.link.connected)
        station.device.reset()  # it has lost its power with its cable
        station.set(NONE)

        await listener.more(2)
        assert listener.source.health.reconnects >= 1


async def test_where_the_model_is_left_open_the_baud_rates_are_tried_in_turn(
    tmp_path: Path,
) -> None:
    its = options(tmp_path)
    async with emulated(RplidarDevice, its) as station:
        station.set(Faults(silence=True))
        async with listen(its) as listener:
            source = listener.source
            await until(lambda: source.baud == 460_800)
            await until(lambda: source.baud == 1_000_000)
            station.set(NONE)
            await listener.more(1)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (
            {"model": "s2"},
            "what comes from {}/scan at 1000000 baud is no RPLIDAR: "
            "it looks like an LDROBOT lidar (ld06, ld19, lds02) (model: s2)",
        ),
        (
            {},
            "no RPLIDAR answers on {}/scan at any of 115200, 460800, 1000000, 256000 baud: "
            "it looks like an LDROBOT lidar (ld06, ld19, lds02)",
        ),
    ],
)
async def test_another_lidar_on_the_port_is_named_once(
    settings: dict[str, Any], expected: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    its = options(tmp_path, **settings)
    async with emulated(LdDevice, its), listen(its) as listener:
        await until(lambda: listener.source.problem)
        await asyncio.sleep(1.5)
        assert listener.source.problem == expected.format(tmp_path)
        assert len(caplog.records) == 1


async def test_a_wrong_model_means_a_wrong_baud_rate_and_so_silence_which_is_told(
    tmp_path: Path,
) -> None:
    its = options(tmp_path, model="a1")
    async with emulated(RplidarDevice, its) as station:
        station.set(Faults(deaf=True))
        async with listen(its) as listener:
            await until(lambda: listener.source.problem)
            assert listener.source.problem == (
                f"nothing comes from {tmp_path}/scan at 115200 baud: "
                "is the RPLIDAR powered, and wired both ways? (model: a1)"
            )


async def test_another_model_than_the_file_names_is_told_in_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    async with (
        emulated(RplidarDevice, options(tmp_path, model="a2m8")),
        listen(options(tmp_path, model="a1")) as listener,
    ):
        await listener.more(1)
        said = [record.message for record in caplog.records]
        assert f"RPLIDAR A2 on {tmp_path}/scan, firmware 1.29" in said
        assert f"the lidar on {tmp_path}/scan is an RPLIDAR A2, not model: a1" in said


async def test_a_lidar_that_has_stopped_to_protect_itself_is_reset(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    its = options(tmp_path, model="c1")
    async with emulated(RplidarDevice, its) as station:
        assert isinstance(station.device, RplidarDevice)
        station.device.health = Health(2, 0x8001)
        async with listen(its) as listener:
            await listener.more(1)
            assert station.device.health == Health(0, 0)


async def test_closing_stops_the_measurement_and_the_motor(tmp_path: Path) -> None:
    its = options(tmp_path, model="s2")
    async with emulated(RplidarDevice, its) as station:
        async with listen(its) as listener:
            await listener.more(1)
        assert isinstance(station.device, RplidarDevice)
        await until(lambda: station.device._turn_hz == 0.0)
        assert station.device._mode is None


def decoded(model: Any, request: bytes, seconds: float) -> tuple[bytes, Decoder, int]:
    body, wire = waffle(), Wire()
    device = RplidarDevice(body, options(Path(), model=model), wire)
    device.reset()
    wire.sent.clear()
    device.feed(request)
    run_for(body, device, seconds)
    decoder = Decoder()
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
    """A capsule is only understood once the next has come, so one is missing in a second."""
    first, decoder, found = decoded(model, request_bytes, 1.0)

    assert first == bytes.fromhex(descriptor)
    assert (found, decoder.errors) == (blocks, 0)


def test_an_a2_does_not_turn_before_its_board_is_told_to_and_an_s2_stops_at_speed_zero() -> None:
    assert decoded("a2m8", rplidar.request(rplidar.SCAN), 0.2)[2] == 0
    pwm = rplidar.request(rplidar.SET_PWM, (660).to_bytes(2, "little"))
    assert decoded("a2m8", rplidar.request(rplidar.SCAN) + pwm, 0.2)[2] == 400
    stop = rplidar.request(rplidar.SET_SPEED, bytes(2))
    assert decoded("s2", stop + rplidar.request(rplidar.SCAN), 0.2)[2] == 0


class Scripted:
    """A lidar that has the given scan modes: answer type and microseconds a sample."""

    def __init__(self, typical: int, modes: list[tuple[int, int]]) -> None:
        self._typical, self._modes = typical, modes

    def send(self, data: bytes) -> None: ...

    def motor(self, *, on: bool) -> None: ...

    def known(self, info: Info, *, pwm: bool) -> None: ...

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
        ((1, 29), 0x18, "auto", (EXPRESS, 1)),  # its typical mode, 84, is not understood here
        ((1, 29), 0x18, "standard", (STANDARD, 0)),
        ((1, 20), 0x18, "auto", (EXPRESS, 0)),  # too old to be asked
        ((1, 15), 0x18, "auto", (STANDARD, 0)),  # too old for express
        ((1, 1), 0x41, "auto", (EXPRESS, 1)),  # a C1 can be asked whatever its firmware
    ],
)
async def test_the_scan_mode_is_one_that_both_sides_know(
    firmware: tuple[int, int], model: int, scan_mode: str, expected: tuple[int, int]
) -> None:
    info = Info(model, firmware, 7, "00" * 16)

    assert await choose(Scripted(2, A1_MODES), info, scan_mode) == expected


@pytest.mark.parametrize("firmware", [(1, 29), (1, 20)])
async def test_a_scan_mode_that_the_lidar_has_not_is_refused(firmware: tuple[int, int]) -> None:
    info = Info(0x18, firmware, 7, "00" * 16)

    with pytest.raises(Trouble, match="no scan_mode 'dense'"):
        await choose(Scripted(2, A1_MODES), info, "dense")
