"""How old data may be that moves the body."""

from gigabrain_schemas.body import BodyDescription


def scan_limit_ns(body: BodyDescription) -> int:
    """How old sensor data may be that moves the body: 250 ms, or 1.5 scans where that is more."""
    period_ns = 1e9 / body.lidar.rate_hz if body.lidar else 0.0
    return round(max(250e6, 1.5 * period_ns))
