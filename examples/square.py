"""Drive a square: `move` and `turn` measure themselves by odometry."""

import math

import gigabrain_zenoh

SIDE_M = 0.4

with gigabrain_zenoh.connect(take=True) as robot:  # take over from the robot's own brain
    for side in range(4):
        moved = robot.move(SIDE_M)
        turned = robot.turn(math.pi / 2)
        print(f"side {side + 1}: {moved.distance:.3f} m, {math.degrees(turned.angle):.1f} deg")
        if not moved.ok:
            print(f"held back: {', '.join(moved.held_back)}")
