"""Draw the map that the robot makes, with the robot in it, as map.png."""

import cv2
import numpy as np

import gigabrain_zenoh

SCALE = 4  # pixels for each cell

with gigabrain_zenoh.connect() as robot:
    grid = robot.get_sensor_data("map")
    pose = robot.get_sensor_data("pose")

cells = grid.array()  # (height, width): -1 unknown, 0 free, 100 occupied
picture = np.full((*cells.shape, 3), 128, np.uint8)
picture[cells >= 0] = 255 - cells[cells >= 0, None] * 2.55
picture = np.kron(picture, np.ones((SCALE, SCALE, 1), np.uint8))
column = round((pose.x - grid.origin_x) / grid.resolution * SCALE)
row = round((pose.y - grid.origin_y) / grid.resolution * SCALE)
cv2.circle(picture, (column, row), 3 * SCALE, (0, 0, 255), -1)
cv2.imwrite("map.png", picture[::-1])  # y up
print(f"map.png: {grid.width * grid.resolution:.1f} x {grid.height * grid.resolution:.1f} m")
