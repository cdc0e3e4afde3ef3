"""Read a recording into numpy arrays: python read_recording.py drive.mcap."""

import sys
from pathlib import Path

import msgspec
import numpy as np

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.recording.bag_reader import samples

if len(sys.argv) != 2:
    sys.exit("usage: python read_recording.py drive.mcap")
poses, ranges = [], []
for sample in samples(Path(sys.argv[1])):
    if sample.key == "robot/state":
        state = msgspec.msgpack.decode(sample.payload, type=RobotState)
        poses.append((state.stamp_ns / 1e9, state.pose.x, state.pose.y, state.pose.yaw))
    elif sample.key == "robot/scan":
        ranges.append(msgspec.msgpack.decode(sample.payload, type=LaserScan).ranges_m)

track, scans = np.array(poses), np.stack(ranges)
way = np.hypot(*np.diff(track[:, 1:3], axis=0).T).sum()
print(f"{len(track)} states over {np.ptp(track[:, 0]):.1f} s, {way:.2f} m driven")
print(f"{scans.shape[0]} scans of {scans.shape[1]} beams, nearest {np.nanmin(scans):.2f} m")
