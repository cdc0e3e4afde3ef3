"""Imported by a fork server: its forks share what numba makes at the first call of a kernel."""

from gigabrain_zenoh.kernels.jit import numba

numba.core.registry.cpu_target.typing_context.refresh()
