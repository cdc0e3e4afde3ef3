"""Processes that import modules for others, and fork them, so that they share memory.

A fork server holds no session and no keys, and runs no thread. A fork ends up as a child of the
supervisor, not of the server, so it goes on when the server ends:

    supervisor   the levels of imports, with a connection for each      -> fork server
    fork server  its pid, once it has imported                          -> supervisor
    supervisor   a request, with the ends of three pipes                -> fork server
    fork server  forks twice; the process between them ends             -> the fork
    the fork     its pid, once the supervisor is its parent             -> supervisor
    supervisor   a byte in the third pipe, or closes it: do not run     -> the fork, which runs

`gigabrain up` starts the server first, which imports while the command reads its files. The servers
end when all processes are started; a process that is restarted later imports by itself.
If a server imported more after a fork, it would copy pages and share fewer with that fork. So each
level of imports has its own server, forked from the server of the level before.
"""

import contextlib
import gc
import importlib
import os
import socket
import sys
import time
from collections.abc import Sequence
from typing import NoReturn

import msgspec
from msgspec import Struct

from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.plugins import find

MAX_REQUEST_BYTES = 128 * 1024
MAX_LEVELS = 8
ADOPTION_TIMEOUT_S = 5.0  # for a fork to become a child of the supervisor
ADOPTION_POLL_S = 0.0002


class ForkRequest(Struct, frozen=True):
    """One process to start."""

    run: str  # "module:function" that runs in it with `argument`, and returns its exit code
    argument: str
    title: str  # for ps(1)
    imports: tuple[tuple[str, ...], ...]  # modules that the server of each level imports for it


def main() -> NoReturn:
    """Serve the requests of a supervisor, until it ends or closes the connections.

    The arguments are the file descriptor of the first connection, and modules to import at once.
    """
    supervisor = os.getppid()
    this_process.set_up()
    first = socket.socket(fileno=int(sys.argv[1]))
    _import(sys.argv[2:])
    data, ends, _, _ = socket.recv_fds(first, MAX_REQUEST_BYTES, MAX_LEVELS)
    if not data:
        os._exit(0)
    levels = msgspec.json.decode(data, type=list[tuple[str, ...]])
    connections = [first, *(socket.socket(fileno=end) for end in ends)]
    for modules in levels:
        _import(modules)
        gc.collect()
        gc.freeze()  # later collections in a fork do not write to shared pages
        this = os.getpid()
        if len(connections) == 1 or os.fork():
            break
        this_process.die_with_parent(this)
        connections.pop(0).close()
    for connection in connections[1:]:
        connection.close()
    _serve(connections[0], supervisor)


def _import(modules: Sequence[str]) -> None:
    for module in modules:
        with contextlib.suppress(ImportError):  # the process that needs it reports it
            importlib.import_module(module)


def _serve(connection: socket.socket, supervisor: int) -> NoReturn:
    connection.send(str(os.getpid()).encode())
    while True:
        data, ends, _, _ = socket.recv_fds(connection, MAX_REQUEST_BYTES, 3)
        if not data:
            os._exit(0)
        if first := os.fork():
            os.waitpid(first, 0)
        elif os.fork():
            os._exit(0)
        else:
            _become(msgspec.json.decode(data, type=ForkRequest), ends, connection, supervisor)
        for end in ends:
            os.close(end)


def _become(
    request: ForkRequest, ends: Sequence[int], connection: socket.socket, supervisor: int
) -> NoReturn:
    """Become a process of the supervisor, and run until its end."""
    from setproctitle import setproctitle  # installed on Linux only

    os.setsid()
    deadline_s = time.monotonic() + ADOPTION_TIMEOUT_S
    while os.getppid() != supervisor:
        if time.monotonic() > deadline_s:
            os._exit(1)
        time.sleep(ADOPTION_POLL_S)
    this_process.die_with_parent(supervisor)
    out, err, go = ends
    try:
        connection.send(str(os.getpid()).encode())
        started = os.read(go, 1)
    except OSError:
        started = b""
    if not started:
        os._exit(1)
    os.dup2(out, 1)
    os.dup2(err, 2)
    os.closerange(3, max(*ends, connection.detach()) + 1)
    setproctitle(request.title)
    code: int = find(request.run)(request.argument)
    sys.stdout.flush()
    os._exit(code)


if __name__ == "__main__":
    main()
