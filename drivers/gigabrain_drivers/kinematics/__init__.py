"""Kinematics of wheels and legs, dead reckoning, and a trot. Pure; imports no bus."""

Vector = tuple[float, float, float]  # x, y, z
Quaternion = tuple[float, float, float, float]  # x, y, z, w
