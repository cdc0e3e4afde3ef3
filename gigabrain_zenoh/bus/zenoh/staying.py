"""Keeps Python's thread state of a foreign thread, for hundreds of callbacks per second.

A foreign thread, such as Zenoh's, gets a Python thread state when a callback begins. It loses the
state when the callback ends. This is a quarter of the cost of a small message.
"""

import ctypes
import threading

_here = threading.local()


def stay() -> None:
    """Keep the thread state of the calling thread until the thread ends. Call it within a callback.

    PyGILState_Ensure counts its calls. The extra call here is never released, so the count returns
    to one and never to zero when the callback ends.
    """
    if not getattr(_here, "stays", False):
        _here.stays = True
        ctypes.pythonapi.PyGILState_Ensure()
