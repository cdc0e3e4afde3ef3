"""Closing a connection must not wait for a peer that is gone.

Zenoh 1.10 has its TCP sockets linger for 10 s. A close that finds something unsent then stands
still, and with it all that its thread has to do: a router whose client has lost its cable forwards
nothing to anybody (zenoh#2718, zenoh#2350). There is no setting for it, so it is put right on the
sockets.
"""

import contextlib
import os
import socket
import stat
import struct

_OFF = struct.pack("ii", 0, 0)
OWN_FILES = "/dev/fd"  # what this process has open, on Linux and on macOS


def close_in_background() -> int:
    """Have the kernel finish what this process's TCP sockets owe when closed; how many changed."""
    names = os.listdir(OWN_FILES) if os.path.isdir(OWN_FILES) else ()
    return sum(_changed(int(name)) for name in names)


def _changed(fd: int) -> bool:
    with contextlib.suppress(OSError):  # closed meanwhile
        if not stat.S_ISSOCK(os.fstat(fd).st_mode):
            return False
        with socket.socket(fileno=os.dup(fd)) as same:
            lingers, _ = struct.unpack(
                "ii", same.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8)
            )
            if same.family in (socket.AF_INET, socket.AF_INET6) and lingers:
                same.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _OFF)
                return True
    return False
