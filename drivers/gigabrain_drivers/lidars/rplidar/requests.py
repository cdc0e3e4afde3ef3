"""Slamtec RPLIDAR from the lidar's side: what a host asks for, out of a stream of bytes."""

from typing import NamedTuple

from gigabrain_drivers.lidars.rplidar import protocol as rplidar

REQUESTS = {
    rplidar.STOP: "stop", rplidar.RESET: "reset",
    rplidar.SCAN: "scan", rplidar.FORCE_SCAN: "force scan", rplidar.EXPRESS_SCAN: "express scan",
    rplidar.GET_INFO: "get info", rplidar.GET_HEALTH: "get health",
    rplidar.GET_SAMPLERATE: "get sample rate", rplidar.GET_BOARD: "get board",
    rplidar.GET_CONF: "get setting", rplidar.SET_SPEED: "set speed", rplidar.SET_PWM: "set motor",
}  # fmt: skip
_BEFORE_CHECKSUM = 3  # bytes of a request with a payload before the payload


class Request(NamedTuple):
    """What a host asks for."""

    command: int
    payload: bytes = b""


def describe_request(request: Request) -> str:
    """What a host asks for, in words."""
    name = REQUESTS.get(request.command, f"request {request.command:#04x}")
    return f"{name} {request.payload.hex(' ')}".strip()


class RequestDecoder:
    """The lidar's side: requests out of a stream of bytes. Keeps less than 260 bytes."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.errors = 0

    def feed(self, data: bytes) -> list[Request]:
        """The requests that `data` completes."""
        buffer, found = self._buffer, list[Request]()
        buffer += data
        while True:
            self._skip()
            if len(buffer) < 2:
                return found
            if buffer[1] < 0x80:
                found.append(Request(buffer[1]))
                del buffer[:2]
                continue
            if len(buffer) < _BEFORE_CHECKSUM or len(buffer) < buffer[2] + 4:
                return found
            whole = bytes(buffer[: buffer[2] + 4])
            if rplidar.xor(whole) == 0:
                found.append(Request(whole[1], whole[_BEFORE_CHECKSUM:-1]))
                del buffer[: len(whole)]
            else:
                self.errors += 1
                del buffer[:1]

    def _skip(self) -> None:
        at = self._buffer.find(0xA5)
        del self._buffer[: at if at >= 0 else len(self._buffer)]
