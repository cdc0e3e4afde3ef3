"""How an RPLIDAR is started: who it is, how it feels, its motor, its scan mode, its stream."""

import asyncio
from typing import NamedTuple, Protocol

from gigabrain_drivers.lidars.rplidar import protocol as rplidar
from gigabrain_drivers.lidars.rplidar.protocol import Health, Info
from gigabrain_drivers.lidars.rplidar.scan_formats import FORMATS

STOP_S = 0.1  # the vendor waits so long after a stop
RESET_S = 2.0
PWM_FAMILIES = range(2, 6)  # which may sit on a board that powers the motor
CONF_FIRMWARE = (1, 24)  # from here on it can be asked for its scan modes; C1 and later always
CONF_FAMILY = 4
EXPRESS_FIRMWARE = (1, 17)  # from here on it has the express mode


class Trouble(Exception):
    """Why it does not scan, in one line for people."""


class Model(NamedTuple):
    """What a model's name says of it."""

    baud: int
    family: int  # high nibble of the model that it reports


MODELS = {
    "a1": Model(115_200, 1),
    "a2m8": Model(115_200, 2),
    "a2m12": Model(256_000, 2),
    "a3": Model(256_000, 3),
    "c1": Model(460_800, 4),
    "s1": Model(256_000, 6),
    "s2": Model(1_000_000, 7),
    "s3": Model(1_000_000, 8),
}
BAUDS = (115_200, 460_800, 1_000_000, 256_000)
FAMILIES = {1: "A1", 2: "A2", 3: "A3", 4: "C1", 6: "S1", 7: "S2", 8: "S3"}
KINDS = {"standard": rplidar.STANDARD, "express": rplidar.EXPRESS, "dense": rplidar.DENSE}


class Line(Protocol):
    """What the start-up needs of whoever has the port."""

    def send(self, data: bytes) -> None:
        """To the lidar."""

    async def ask(self, request: bytes, kind: int) -> bytes:
        """The single answer to a request. Raises Trouble."""

    def motor(self, *, on: bool) -> None:
        """Let it turn, or stop."""

    def known(self, info: Info, *, pwm: bool) -> None:
        """It has said who it is, and whether a board powers its motor."""


async def start(line: Line, scan_mode: str) -> None:
    """From any state to a stream of samples, in the order of the vendor's SDK. Raises Trouble."""
    await _stop(line)
    info = Info.read(await line.ask(rplidar.request(rplidar.GET_INFO), rplidar.INFO))
    line.known(info, pwm=await _on_board(line, info))
    await _check_health(line)
    line.motor(on=True)
    await _stop(line)
    kind, mode = await choose(line, info, scan_mode)
    if kind == rplidar.STANDARD:
        line.send(rplidar.request(rplidar.SCAN))
    else:
        line.send(rplidar.express_request(mode))


async def choose(line: Line, info: Info, scan_mode: str) -> tuple[int, int]:
    """The answer type and number of the scan mode to use. Raises Trouble.

    `auto` is the lidar's typical mode, or the fastest of those that are understood here.
    """
    if info.firmware < CONF_FIRMWARE and info.model >> 4 < CONF_FAMILY:
        return _old_mode(info, scan_mode), 0
    wanted = set(FORMATS) if scan_mode == "auto" else {KINDS[scan_mode]}
    typical = _number(await _conf(line, rplidar.MODE_TYPICAL))
    kind = await _kind(line, typical)
    if kind in wanted:
        return kind, typical
    fitting = []
    for mode in range(_number(await _conf(line, rplidar.MODE_COUNT))):
        if (kind := await _kind(line, mode)) in wanted:
            period = _number(await _conf(line, rplidar.MODE_MICROSECONDS, mode))
            fitting.append((period, kind, mode))
    if not fitting:
        raise Trouble(f"this RPLIDAR has no scan_mode {scan_mode!r} that is understood here")
    return min(fitting)[1:]


def _old_mode(info: Info, scan_mode: str) -> int:
    """The answer type of firmware that cannot be asked for its modes."""
    has = {"standard": rplidar.STANDARD}
    if info.firmware >= EXPRESS_FIRMWARE:
        has |= {"auto": rplidar.EXPRESS, "express": rplidar.EXPRESS}
    if scan_mode not in {*has, "auto"}:
        version = ".".join(map(str, info.firmware))
        raise Trouble(f"this RPLIDAR's firmware {version} has no scan_mode {scan_mode!r}")
    return has.get(scan_mode, rplidar.STANDARD)


async def _stop(line: Line) -> None:
    line.send(rplidar.request(rplidar.STOP))
    await asyncio.sleep(STOP_S)


async def _on_board(line: Line, info: Info) -> bool:
    if info.model >> 4 not in PWM_FAMILIES:
        return False
    try:
        flags = await line.ask(rplidar.request(rplidar.GET_BOARD, bytes(4)), rplidar.BOARD)
    except Trouble:  # there is nobody to answer where there is no board
        return False
    return bool(flags[0] & 1)


async def _check_health(line: Line) -> None:
    health = Health.read(await line.ask(rplidar.request(rplidar.GET_HEALTH), rplidar.HEALTH))
    if health.status == 2:
        line.send(rplidar.request(rplidar.RESET))
        await asyncio.sleep(RESET_S)
        raise Trouble(f"the RPLIDAR has stopped to protect itself, code {health.code}; was reset")


async def _kind(line: Line, mode: int) -> int:
    return (await _conf(line, rplidar.MODE_ANSWER, mode))[0]


async def _conf(line: Line, key: int, mode: int | None = None) -> bytes:
    """The value of a setting, at least one byte. Raises Trouble."""
    data = await line.ask(rplidar.conf_request(key, mode), rplidar.CONF)
    if int.from_bytes(data[:4], "little") != key or len(data) < 5:
        raise Trouble(f"the RPLIDAR does not say its setting 0x{key:02x}")
    return data[4:]


def _number(data: bytes) -> int:
    return int.from_bytes(data, "little")
