"""Kernels: functions compiled once by numba, kept on disk, and warmed up before a robot drives.

It may import host.
Mapping, navigation and the processes that warm them up may import it.
"""
