"""Kinematics of wheels and legs, dead reckoning, and a trot. Pure; imports no bus.

Imports `driver.robot` at most. Bodies, `sim` and `emulators` use it.
"""

Vector = tuple[float, float, float]  # x, y, z
Quaternion = tuple[float, float, float, float]  # x, y, z, w
