"""Kinematics of wheels and legs, odometry, and a trot controller. Pure; imports no bus.

Imports only `driver.robot`. Bodies, `sim` and `emulators` use it.
"""

Vector = tuple[float, float, float]  # x, y, z
Quaternion = tuple[float, float, float, float]  # x, y, z, w
