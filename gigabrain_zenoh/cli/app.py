"""The table of commands. Importing it is what `gigabrain --help` costs: keep it light."""

import contextlib
import os
import sys
from collections.abc import Sequence

from cyclopts import App, CycloptsError

from gigabrain_zenoh.errors import ConfigError, GigabrainError

FOLDER = "gigabrain_zenoh.cli"
COMMANDS = (  # name, module and function, what it does
    ("demo", "run:demo", "Drive a simulated robot round a room, until Ctrl-C."),
    ("up", "run:up", "Start what a deployment file puts on this host, and keep it running."),
    ("router", "process:router", "Start the router that joins the other processes."),
    ("perception", "process:perception", "Start perception."),
    ("decision", "process:decision", "Start decision."),
    ("control", "process:control", "Start control."),
    ("safety", "process:safety", "Start safety."),
    ("estop", "operate:estop", "Stop the robot at once, and latch it."),
    ("release", "operate:release", "Let go of a latched gate."),
    ("enable", "operate:enable", "Let the robot's brain drive."),
    ("robots", "names:robots", "List the robots that there are."),
    ("worlds", "names:worlds", "List the simulated worlds that there are."),
    ("view", "view:view", "Draw a robot in its world into a PNG file."),
)


def make_app(chosen: Sequence[str] = ()) -> App:
    """All commands, by name, with the module that holds each.

    A command that is among the `chosen` words brings its own help; of the others a line will do,
    so that they need not be imported.
    """

    def add(to: App, where: str, name: str, summary: str) -> None:
        told = None if name in chosen else summary
        to.command(f"{FOLDER}.{where}", name=name, help=told)

    app = App(
        name="gigabrain",
        help="A robot brain of three systems that any body can wear.",
        help_format="plaintext",  # the default, Markdown, takes twice as long to start
        version=_version,
    )
    for name, where, summary in COMMANDS:
        add(app, where, name, summary)
    groups = (
        ("driver", "run", "process:driver", "Drivers of bodies.", "Start the driver of a body."),
        ("schema", "export", "schema:export", "Messages.", "Write JSON Schema of every message."),
    )
    for group, name, where, about, summary in groups:
        sub = App(name=group, help=about)
        add(sub, where, name, summary)
        app.command(sub)
    bench = App(name="bench", help="Measure this machine.")
    add(bench, "bench:chain", "chain", "From scan to command, timed.")
    add(bench, "bench:stack", "stack", "CPU, memory and time to start.")
    app.command(bench)
    add(app, "completion:completion", "completion", "Shell completion.")
    return app


def _version() -> str:
    from gigabrain_zenoh.version import __version__  # takes a while: only when asked for

    return __version__


def main() -> None:
    """Entry of the `gigabrain` command."""
    call = make_app(sys.argv[1:])
    try:
        code = call(exit_on_error=False, print_error=False, result_action="return_value")
    except GigabrainError as error:
        print(f"gigabrain: {error}", file=sys.stderr)
        code = error.exit_code
    except CycloptsError as error:
        print(f"gigabrain: {' '.join(str(error).split())}", file=sys.stderr)
        code = ConfigError.exit_code
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:  # nobody reads on, as in `gigabrain robots | head -1`
        code = 1
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.flush()
    with contextlib.suppress(BrokenPipeError):
        sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 0)  # Zenoh's threads must not hold it back
