"""Send the robot to a place in its map, and print what it reached."""

import sys

import gigabrain_zenoh

if len(sys.argv) not in (1, 3):
    sys.exit("usage: python go_to.py [X Y]")
x, y = (float(word) for word in sys.argv[1:] or (0.5, 0.0))

with gigabrain_zenoh.connect() as robot:
    task = robot.goto(x, y)  # plans round obstacles; returns once the task has ended
    print(task.state, "-", task.reason)
    if task.position_error is not None:
        print(f"{task.position_error:.2f} m from the goal")
