"""Loads linked kernels, or else numba's set-up, in a fork server, so that its forks share them."""

from gigabrain_zenoh.kernels.jit import import_numba
from gigabrain_zenoh.kernels.linked import load_all

if not load_all():
    import_numba().core.registry.cpu_target.typing_context.refresh()
