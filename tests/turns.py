"""Tests run beside those of other processes, or have the machine to themselves for a while.

`make test` runs two processes of tests. Whoever wants to be alone shuts the door, so that nobody
begins a test any more, and waits until the room is empty.
"""

import fcntl
from pathlib import Path

DOOR = Path(__file__)
ROOM = DOOR.with_name("conftest.py")


class Turns:
    """The locks of two files, as this process holds them; they end with it."""

    def __init__(self, door: Path = DOOR, room: Path = ROOM) -> None:
        self._door, self._room = door.open(), room.open()

    def beside(self) -> None:
        """Begin while other processes may run tests, too; waits for whoever is alone."""
        self._enter(fcntl.LOCK_SH)

    def alone(self) -> None:
        """Begin while no other process runs a test, and none begins one; waits for theirs."""
        self._enter(fcntl.LOCK_EX)

    def leave(self) -> None:
        """End, however it was begun."""
        fcntl.flock(self._room, fcntl.LOCK_UN)

    def close(self) -> None:
        """Let go of the files, and of what is held."""
        self._door.close()
        self._room.close()

    def _enter(self, how: int) -> None:
        self.leave()
        fcntl.flock(self._door, how)
        fcntl.flock(self._room, how)
        fcntl.flock(self._door, fcntl.LOCK_UN)


TURNS = Turns()
