"""The table of commands. Importing it is what `gigabrain --help` costs: keep it light."""

import os
import sys

from cyclopts import App, CycloptsError

from gigabrain_zenoh.errors import ConfigError, GigabrainError

COMMANDS = "gigabrain_zenoh.cli"
TRACE = """Show the bytes on a body's line, decoded.

Starts the driver itself, on an emulator of its own or on the real port, where it commands zero only.
A driver that runs already logs the same lines with: gigabrain driver run NAME --level debug
"""


def make_app() -> App:
    """All commands, by name, with the module that holds each."""
    app = App(
        name="gigabrain",
        help="A robot brain of three systems that any body can wear.",
        help_format="plaintext",  # the default, Markdown, takes twice as long to start
        version=_version,
    )
    lazy = (
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
        (
            "emulate",
            "emulate:emulate",
            "Be a robot's body on real ports, in MuJoCo.",
        ),
        ("robots", "names:robots", "List the robots that there are."),
        ("worlds", "names:worlds", "List the simulated worlds that there are."),
        ("view", "view:view", "Draw a robot in its world into a PNG file."),
    )
    for name, where, summary in lazy:
        app.command(f"{COMMANDS}.{where}", name=name, help=summary)
    groups = (
        ("driver", "run", "process:driver", "Drivers of bodies.", "Start the driver of a body."),
        ("driver", "new", "driver_kit:new", "", "Write the package of a new driver."),
        ("driver", "test", "driver_kit:test", "", "Check a driver against all that it must do."),
        ("driver", "trace", "driver_kit:trace", "", TRACE),
        ("schema", "export", "schema:export", "Messages.", "Write JSON Schema of every message."),
    )
    subs: dict[str, App] = {}
    for group, name, where, about, summary in groups:
        if group not in subs:
            subs[group] = App(name=group, help=about)
            app.command(subs[group])
        subs[group].command(f"{COMMANDS}.{where}", name=name, help=summary)
    bench = App(name="bench", help="Measure this machine.")
    bench.command(f"{COMMANDS}.bench:chain", name="chain", help="From scan to command, timed.")
    bench.command(f"{COMMANDS}.bench:stack", name="stack", help="CPU, memory and time to start.")
    bench.command(
        f"{COMMANDS}.bench_bodies:bodies",
        name="bodies",
        help="One brain, all bodies, side by side.",
    )
    app.command(bench)
    app.command(f"{COMMANDS}.completion:completion", name="completion", help="Shell completion.")
    return app


def _version() -> str:
    from gigabrain_zenoh.version import __version__  # takes a while: only when asked for

    return __version__


def main() -> None:
    """Entry of the `gigabrain` command."""
    call = make_app()
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
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 0)  # Zenoh's threads must not hold it back
