"""Follow the wall on the right for some seconds, by the lidar alone."""

import math

import numpy as np

import gigabrain_zenoh

DISTANCE_M, SPEED, SECONDS = 0.5, 0.12, 8.0


def nearest(scan, degrees: float) -> float:
    """Return the nearest range [m] within 20 degrees of a direction; 9 m for none."""
    off = np.remainder(scan.angles - math.radians(degrees) + math.pi, math.tau) - math.pi
    near = scan.ranges_m[(np.abs(off) < math.radians(20)) & np.isfinite(scan.ranges_m)]
    return float(near.min(initial=9.0))


with gigabrain_zenoh.connect(take=True) as robot:
    for count, scan in enumerate(robot.topic("scan", timeout=5)):
        ahead, right = nearest(scan, 0), nearest(scan, -90)
        if ahead < 0.6:
            linear, angular = 0.0, 0.8  # a wall ahead: turn left
        else:
            linear, angular = SPEED, float(np.clip(1.5 * (DISTANCE_M - right), -0.6, 0.6))
        robot.set_base_velocity(linear, 0.0, angular)
        if count % 10 == 0:
            print(f"ahead {ahead:.2f} m, right {right:.2f} m")
        if count >= SECONDS * 10:  # ten scans a second
            break
