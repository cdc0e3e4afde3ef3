"""Kernels: functions that numba compiles once, kept on disk, and loaded before a robot drives.

It may import host.
Mapping, navigation and the processes that load kernels may import it.
"""
