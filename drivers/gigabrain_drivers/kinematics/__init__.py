"""Kinematics of wheels and legs, dead reckoning, and a trot. Pure; imports no bus."""
