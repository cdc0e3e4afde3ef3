"""Keeps Python's own record of a foreign thread, for callbacks that come by the hundred a second.

A thread that is not Python's, such as Zenoh's, is given that record when a callback begins, and
loses it with its memory when the callback ends: a quarter of what a small message costs.
"""

import ctypes
import threading

_here = threading.local()


def stay() -> None:
    """Called within a callback: this thread keeps its record until it ends itself.

    As PyGILState_Ensure has it, which counts how often it is called; the count of the callback
    around this call goes back to one and never to zero.
    """
    if not getattr(_here, "stays", False):
        _here.stays = True
        ctypes.pythonapi.PyGILState_Ensure()
