"""Several hosts on one machine: network namespaces with a veth pair each, joined by a switch.

The namespaces have no names. They live as long as a process is in them. The process that holds
them ends with its stdin, so nothing is left even if a test is killed.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

import pytest

HOLD = "ip link set lo up && echo held && exec cat"


class Namespace:
    """One network namespace, held by a process."""

    def __init__(self) -> None:
        self._holder = subprocess.Popen(
            ("unshare", "--net", "sh", "-c", HOLD),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._holder.stdout
        if self._holder.stdout.readline() != "held\n":
            _, complaint = self._holder.communicate()
            raise OSError(f"no network namespace: {' '.join(complaint.split())}")
        self.pid = self._holder.pid

    @property
    def inside(self) -> tuple[str, ...]:
        """Return the prefix of a command that runs it in this namespace."""
        return ("nsenter", f"--net=/proc/{self.pid}/ns/net", "--")

    def close(self) -> None:
        """End the holding process; the namespace ends with its last process."""
        self._holder.communicate()


class Network:
    """A switch with hosts, and this process as another host at the address `ours`."""

    def __init__(self, stack: ExitStack, names: Sequence[str], subnet: int) -> None:
        net = f"198.18.{subnet}"  # reserved for tests by RFC 2544
        self._switch = _held(stack)
        self._in_switch("link", "add", "switch", "type", "bridge")
        self._in_switch("link", "set", "switch", "up")
        self.hosts = {name: _held(stack) for name in names}
        self.address = {name: f"{net}.{number}" for number, name in enumerate(names, 1)}
        for name, host in self.hosts.items():
            _ip(
                "link", "add", name, "netns", str(self._switch.pid),
                "type", "veth", "peer", "name", "eth0", "netns", str(host.pid),
            )  # fmt: skip
            _ip("address", "add", f"{self.address[name]}/24", "dev", "eth0", inside=host)
            _ip("link", "set", "eth0", "up", inside=host)
            self.join(name)
        self.ours, ours = f"{net}.254", f"gb{os.getpid()}n{subnet}"
        _ip("link", "add", ours, "type", "veth", "peer", "name", "ours", "netns", self._pid)
        stack.callback(subprocess.run, ("ip", "link", "delete", ours), capture_output=True)
        _ip("address", "add", f"{self.ours}/24", "dev", ours)
        _ip("link", "set", ours, "up")
        self.join("ours")

    @property
    def _pid(self) -> str:
        return str(self._switch.pid)

    def join(self, name: str) -> None:
        """Connect a host to the switch."""
        self._in_switch("link", "set", name, "master", "switch", "up")

    def cut(self, name: str) -> None:
        """Disconnect a host from the switch."""
        self._in_switch("link", "set", name, "down")

    def _in_switch(self, *words: str) -> None:
        _ip(*words, inside=self._switch)


def _held(stack: ExitStack) -> Namespace:
    namespace = Namespace()
    stack.callback(namespace.close)
    return namespace


def _ip(*words: str, inside: Namespace | None = None) -> None:
    """Run one `ip` command. Raises OSError with the error text of `ip`."""
    prefix = inside.inside if inside else ()
    done = subprocess.run((*prefix, "ip", *words), capture_output=True, text=True)
    if done.returncode:
        raise OSError(f"ip {' '.join(words)}: {' '.join(done.stderr.split())}")


@contextmanager
def network(*names: str, subnet: int = 77) -> Iterator[Network]:
    """Yield hosts with those names on one switch; skip the test where that is impossible.

    Networks that exist at the same time need different `subnet`s, below 256.
    """
    if os.geteuid() != 0:
        pytest.skip("network namespaces need root")
    for tool in ("ip", "unshare", "nsenter"):
        if not shutil.which(tool):
            pytest.skip(f"network namespaces need {tool}")
    with ExitStack() as stack:
        try:
            made = Network(stack, names, subnet)
        except OSError as error:
            pytest.skip(f"no network of namespaces here: {error}")
        yield made
