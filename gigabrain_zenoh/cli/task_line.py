"""How a task gets on, while somebody waits for it at a terminal."""

import sys

from gigabrain_schemas.tasks import TaskStatus
from gigabrain_zenoh.cli.where import say


class Line:
    """Progress in one line of a terminal; in a pipe a line for each thing that is done."""

    def __init__(self) -> None:
        self._terminal, self._said = sys.stdout.isatty(), ""

    def show(self, name: str, status: TaskStatus) -> None:
        """How far it has come."""
        text = progress(name, status)
        if self._terminal:
            print(f"\r\x1b[K{text}", end="", flush=True)
        elif (head := text.partition(":")[0] + status.doing) != self._said:
            self._said = head
            say(text)

    def end(self) -> None:
        """Leave the line."""
        if self._terminal:
            print("\r\x1b[K", end="", flush=True)


def progress(name: str, status: TaskStatus) -> str:
    """How far a task has come, in a line."""
    current = status.current
    if current is None or current.id != name:
        ahead = [task.id for task in status.queue]
        place = ahead.index(name) + 1 if name in ahead else 0
        return f"{name}: waits, {place} in the queue" if place else f"{name}: accepted"
    if current.state == "paused":
        return f"{name}: paused, {current.reason}"
    if not status.doing:
        return f"{name}: accepted, {current.reason}" if current.reason else f"{name}: accepted"
    parts = [f"{name}: {status.doing}", f"{100 * status.progress:.0f} %"]
    if status.distance_remaining is not None:
        parts.append(f"{status.distance_remaining:.1f} m")
    if status.eta is not None:
        parts.append(f"{status.eta:.0f} s")
    if current.reason != status.doing:
        parts.append(current.reason)
    return ", ".join(parts)
