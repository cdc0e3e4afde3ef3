"""Imported by a fork server: its forks share the linked kernels, or else numba's first set-up."""

from gigabrain_zenoh.kernels.jit import import_numba
from gigabrain_zenoh.kernels.linked import load_all

if not load_all():
    import_numba().core.registry.cpu_target.typing_context.refresh()
