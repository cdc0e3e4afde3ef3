"""Commands that do not decode: did somebody send a speed that is not a number?"""

import msgspec


class RawSpeeds(msgspec.Struct):
    """A command before its numbers are looked at."""

    linear_x: float = 0.0
    linear_y: float = 0.0
    angular_z: float = 0.0
    source: str = ""
    boot: int = 0


def not_finite(payload: bytes) -> tuple[str, int] | None:
    """Source and boot of a command with NaN or infinity in it; None for anything else."""
    try:
        raw = msgspec.msgpack.decode(payload, type=RawSpeeds)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    speeds = (raw.linear_x, raw.linear_y, raw.angular_z)
    if all(abs(speed) < float("inf") for speed in speeds):
        return None
    return raw.source, raw.boot
