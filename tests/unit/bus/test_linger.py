"""A close that waits for nobody."""

import os
import socket
import struct

from gigabrain_zenoh.bus.zenoh.workarounds import disable_linger


def lingers(of: socket.socket) -> tuple[int, ...]:
    return struct.unpack("ii", of.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))


def test_the_tcp_sockets_of_this_process_no_longer_linger() -> None:
    disable_linger()  # of whatever else this process has had open
    with socket.socket() as ours, socket.socket() as other:
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
        before = len(os.listdir("/dev/fd"))
        assert disable_linger() == 1
        assert lingers(ours)[0] == 0
        assert lingers(other)[0] == 0
        assert disable_linger() == 0
        assert len(os.listdir("/dev/fd")) == before
