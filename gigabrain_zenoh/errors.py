"""The tree of errors that a user may see, each in one line with what was expected.

GigabrainError
├── ConfigError       a file or an option is wrong (exit code 2)
│   ├── UnknownName   no such robot, world, driver, process or behaviour
│   ├── NotYetValid   keys that are valid only later: is the clock right?
│   └── DiskFull      a disk without space for a robot's files (exit code 1)
├── BusError          the router is missing, or its port is taken
│   └── Ambiguous     several robots run here, and none was chosen
├── Refused           the robot refused a request, with the reason
├── Unsupported       the body has no such primitive
├── BodyLost          the body no longer answers
├── ClockLost         a process's robot time does not match any state
├── BadPayload        a ROS 2 message that cannot be decoded, or JSON of another type
├── NoAnswer          no ROS 2 node answered a service in time
└── NotConfirmed      no body confirmed an e-stop (exit code 3)
"""

import difflib
import re
from bisect import bisect_right
from collections.abc import Iterable
from itertools import accumulate

MAX_LIST_CHARS = 300  # of the names that an error lists
MAX_UNKNOWN_CHARS = 450  # of the error for an unknown name; replies hold 500

LOGIN = re.compile(r"(?<=://)[^\s\"']*@")  # of an address in a text; a password may hold any of :/@


def without_logins(text: str) -> str:
    """Return a text without the user and the password of each address in it."""
    return LOGIN.sub("…@", text) if "://" in text else text


class GigabrainError(Exception):
    """Base of all errors of this project. `str()` is one line for people."""

    exit_code = 1


class ConfigError(GigabrainError):
    """An invalid configuration; the text names the file, the line and the expected value.

    Files may hold addresses with passwords, so these are left out of the text.
    """

    exit_code = 2

    def __init__(self, text: str, *, value: str | None = None) -> None:
        """Create an error; `value` is the invalid value, used to find its line in a file."""
        super().__init__(without_logins(text))
        self.value = value


class UnknownName(ConfigError):
    """An unknown name."""


class NotYetValid(ConfigError):
    """Keys that are not valid yet; they may be once the clock is set."""


class DiskFull(ConfigError):
    """A folder that cannot be written while its disk is full."""

    exit_code = 1


class BusError(GigabrainError):
    """The bus cannot be reached or cannot be opened."""


class Ambiguous(BusError):
    """Several robots run on this machine, and none was chosen."""


class Refused(GigabrainError):
    """The robot refused a request."""


class StillStopping(Refused):
    """The gate still brakes; ask again when it has stopped."""


class Unsupported(GigabrainError):
    """This body does not have the primitive that was called."""


class BodyLost(GigabrainError):
    """The body no longer answers. The process ends, and its supervisor restarts it."""


class ClockLost(GigabrainError):
    """The robot's time in this process is wrong. It ends, and its supervisor restarts it."""


class BadPayload(GigabrainError):
    """A ROS 2 message that cannot be decoded, or values that do not fit its type."""


class NoAnswer(GigabrainError):
    """No ROS 2 node serves the service, or none answered in time."""


class NotConfirmed(GigabrainError):
    """An e-stop was pressed, but no body confirmed it: a person has to act by hand."""

    exit_code = 3


def unknown(kind: str, name: str, known: Iterable[str]) -> UnknownName:
    """Return the error for a name that is not `known`, with the nearest one as a suggestion.

    Part of a name is enough: `wafle` suggests turtlebot3_waffle.
    """
    names = sorted(known)
    parts = {part: whole for whole in names for part in (*whole.split("_"), whole)}
    close = difflib.get_close_matches(name, parts, n=1, cutoff=0.6)
    hint = f"; did you mean {parts[close[0]]!r}?" if close else ";"
    start = f"no {kind} {name!r}{hint} known: "
    text = start + listed(names, MAX_UNKNOWN_CHARS - len(start))
    text = text.encode(errors="replace").decode()  # file names may contain any bytes
    return UnknownName(text, value=name)


def listed(names: Iterable[str], most_chars: int = MAX_LIST_CHARS) -> str:
    """Return names as text for an error, such as `left, right and 3 more`; `none` without any.

    At least one name is whole, and the whole names have at most `most_chars` characters.
    """
    known = list(names)
    ends = list(accumulate(len(name) + len(", ") for name in known))
    shown = max(1, bisect_right(ends, most_chars))
    text, more = ", ".join(known[:shown]), len(known) - shown
    return f"{text} and {more} more" if more > 0 else text or "none"
