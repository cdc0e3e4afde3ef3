"""Numba: functions compiled once, kept on disk, and warmed up before a robot drives.

It may import host.
Mapping, navigation and those who warm them up may import it.
"""
