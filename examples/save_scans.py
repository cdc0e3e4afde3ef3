"""Save lidar scans as a numpy file: one row of ranges [m] for each scan."""

from itertools import islice

import numpy as np

import gigabrain_zenoh

COUNT = 20

with gigabrain_zenoh.connect() as robot:
    scans = list(islice(robot.topic("scan", timeout=5), COUNT))

ranges = np.stack([scan.ranges_m for scan in scans])
np.save("scans.npy", ranges)
np.save("angles.npy", scans[0].angles)  # [rad], of the columns
print(f"scans.npy: {ranges.shape[0]} scans of {ranges.shape[1]} beams")
