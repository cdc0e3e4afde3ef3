"""How old data may be that moves the body."""

from gigabrain_schemas.body import BodyDescription

REPEAT_TICKS = 2  # safety's verdict is repeated every 40 ms, and at once when it changes


def scan_limit_ns(body: BodyDescription) -> int:
    """How old sensor data may be that moves the body: `scan_age`, or 1.5 scans if that is more."""
    period_ns = 1e9 / body.lidar.rate_hz if body.lidar else 0.0
    return round(max(body.thresholds.scan_age * 1e9, 1.5 * period_ns))
