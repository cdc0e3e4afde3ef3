"""How old data may be that moves the body."""

from gigabrain_schemas.body import BodyDescription


def scan_limit_ns(body: BodyDescription) -> int:
    """How old sensor data may be that moves the body: `scan_age`, or 1.5 scans if that is more."""
    period_ns = 1e9 / body.lidar.rate_hz if body.lidar else 0.0
    return round(max(body.thresholds.scan_age * 1e9, 1.5 * period_ns))
