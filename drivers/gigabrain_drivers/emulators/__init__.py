"""Emulated bodies: real bytes on a pty, TCP port or CAN bus, with simulated physics behind them.

May import every room of this package except bodies. Emulators of bodies and lidars import `base`.
"""
