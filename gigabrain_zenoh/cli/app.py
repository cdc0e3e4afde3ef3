"""The table of commands. Importing it is what `gigabrain --help` costs: keep it light."""

# Nothing here that Python has not imported already: signals are handled as early as can be
import os
import sys

TYPE_CHECKING = False  # as in `typing`
if TYPE_CHECKING:
    from collections.abc import Sequence

    from cyclopts import App

MODULES = "gigabrain_zenoh.cli"

# command -> where it is, and what it does in a line
COMMANDS = {
    "demo": ("demo:demo", "Drive a simulated robot round its world, until Ctrl-C."),
    "up": ("up:up", "Start what a deployment file puts on this host, and keep it running."),
    "router": ("process:router", "Start the router that joins the other processes."),
    "perception": ("process:perception", "Start perception."),
    "decision": ("process:decision", "Start decision."),
    "control": ("process:control", "Start control."),
    "safety": ("process:safety", "Start safety."),
    "driver run": ("process:driver", "Start the driver of a body."),
    "driver new": ("driver_kit:new", "Write the package of a new driver."),
    "driver test": ("driver_kit:test", "Check a driver against all that it must do."),
    "driver trace": ("driver_kit:trace", "Show the bytes on a body's line, decoded."),
    "button": ("process:button", "Start an e-stop button on a serial adapter."),
    "emulate": ("emulate:emulate", "Be a robot's body on real ports, in MuJoCo."),
    "estop": ("operate:estop", "Stop the robot at once, and latch it."),
    "release": ("operate:release", "Let go of a latched gate."),
    "enable": ("operate:enable", "Let the robot's brain drive."),
    "goto": ("tasks:goto", "Send the robot to a place in its map, and wait until it is there."),
    "explore": ("tasks:explore", "Have it drive until nothing is left to be seen."),
    "patrol": ("tasks:patrol", "Have it go round the places of a file."),
    "mission": ("tasks:mission", "Have it carry out a mission, which is a file."),
    "task list": ("tasks:list_", "Show what it is at, what waits, and what was last."),
    "task cancel": ("tasks:cancel", "End what it is at, or another task."),
    "task pause": ("tasks:pause", "Have a task wait."),
    "task resume": ("tasks:resume", "Have a task go on that waits for a person."),
    "keys new": ("keys:new", "Make a fleet's own authority, which issues identities."),
    "keys issue": ("keys:issue", "Make an identity: a folder to copy to its host."),
    "keys revoke": ("keys:revoke", "Call back all identities of a role."),
    "keys list": ("keys:identities", "List identities, and when they expire."),
    "keys zenohd": ("keys:zenohd", "Print the configuration of a router for a larger site."),
    "teleop": ("teleop:teleop", "Drive by keys or by a gamepad."),
    "page": ("page:page", "Serve the operator page: the robot in a browser."),
    "foxglove": ("foxglove:foxglove", "Show the robot in Foxglove or Lichtblick, live."),
    "audit": ("audit:audit", "Show who did what to the robot."),
    "topic list": ("topic:list_", "List topics, their rates, and who talks to whom."),
    "topic echo": ("topic:echo", "Show messages as they come."),
    "topic hz": ("topic:hz", "How often messages come."),
    "topic bw": ("topic:bw", "How many bytes they take."),
    "topic delay": ("topic:delay", "How long they were on their way."),
    "topic info": ("topic:info", "All about one topic."),
    "topic pub": ("topic:pub", "Send a message."),
    "node list": ("node:list_", "List the processes that run."),
    "node info": ("node:info", "All about one process."),
    "graph": ("graph:graph", "Draw who talks to whom."),
    "top": ("top:top", "Watch processes and topics, live."),
    "why": ("why:why", "Why does it not move?"),
    "warm": ("warm:warm", "Compile navigation, so that the first start is quick."),
    "doctor": ("doctor:doctor", "Check this machine and the robot, and say what to do."),
    "log": ("log:log", "Show what the processes have logged."),
    "param list": ("param:list_", "List what may be changed while the robot runs."),
    "param get": ("param:get", "Show one value."),
    "param set": ("param:set_", "Change one value."),
    "map save": ("map:save", "Save the map that a robot makes."),
    "map info": ("map:info", "Check a saved map, and tell its size."),
    "proxy": ("proxy:proxy", "Be a bad network in front of a router or a body's TCP port."),
    "robots": ("names:robots", "List the robots that there are."),
    "worlds": ("names:worlds", "List the simulated worlds that there are."),
    "record": ("record:record", "Record what a robot says into an MCAP file, until Ctrl-C."),
    "bag info": ("bag:info", "What is in a recording."),
    "bag check": ("bag:check", "Whether a recording is whole."),
    "bag recover": ("bag:recover", "Write what can be read of a damaged recording anew."),
    "bag play": ("bag:play", "Send a recording again."),
    "bag plot": ("bag:plot", "Draw numbers of a recording over time, as a PNG."),
    "bag convert": ("bag:convert", "A recording as tables, or as a LeRobot dataset."),
    "replay": ("replay:replay", "Feed a recording to a process and compare what it sends."),
    "view": ("view:view", "Draw a robot in its world into a PNG file."),
    "bench chain": ("bench:chain", "From scan to command, timed."),
    "bench stack": ("bench:stack", "CPU, memory and time to start."),
    "faults": ("faults:faults", "Break the robot on purpose, and see whether it stops."),
    "bench estop": ("bench:estop", "From the press to zero, timed."),
    "bench bodies": ("bench_bodies:bodies", "One brain, all bodies, side by side."),
    "bench goals": ("bench_goals:goals", "Explore, then get to random places."),
    "bench plan": ("bench_plan:plan", "Global planning, timed and checked."),
    "bench slam": ("bench_slam:slam", "Maps from recorded laser logs, and their errors."),
    "bench barn": ("bench_barn:barn", "BARN: through a field of posts, scored."),
    "schema export": ("schema:export", "Write JSON Schema of every message."),
    "completion": ("completion:completion", "Shell completion."),
}
GROUPS = {
    "driver": "Drivers of bodies.",
    "keys": "Who may do what.",
    "bag": "Recordings.",
    "topic": "What goes over the bus.",
    "node": "The processes of a robot.",
    "task": "What the robot was sent to do.",
    "param": "What may be changed at run time.",
    "map": "Maps that a robot has made.",
    "bench": "Measure this machine.",
    "schema": "Messages.",
}


def make_app(chosen: "Sequence[str]" = ()) -> "App":
    """All commands, by name, with the module that holds each.

    A command that is among the `chosen` words brings its own help; of the others a line will do,
    so that they need not be imported.
    """
    from cyclopts import App

    from gigabrain_zenoh.cli.whole import refuse_fractions

    app = App(
        name="gigabrain",
        help="A robot brain of three systems that any body can wear.",
        help_format="plaintext",  # the default, Markdown, takes twice as long to start
        version=_version,
        config=refuse_fractions,
    )
    groups = {name: App(name=name, help=about) for name, about in GROUPS.items()}
    for group in groups.values():
        app.command(group)
    for command, (where, summary) in COMMANDS.items():
        within, _, name = command.rpartition(" ")
        told = None if name in chosen else summary
        groups.get(within, app).command(f"{MODULES}.{where}", name=name, help=told)
    return app


def _version() -> str:
    from gigabrain_zenoh.plugins import package_version  # takes a while: only when asked for

    return package_version()


def main() -> None:
    """Entry of the `gigabrain` command."""
    try:
        from contextlib import suppress

        from gigabrain_zenoh.host.signals import interrupts

        interrupts.install()
    except KeyboardInterrupt:
        os._exit(130)
    try:
        code = _call(sys.argv[1:])
    except KeyboardInterrupt:
        code = interrupts.exit_code
    except BrokenPipeError:  # nobody reads on, as in `gigabrain robots | head -1`
        code = 1
    except Exception:  # what a signal has broken off may complain in any words
        if not interrupts.received:
            raise
        code = interrupts.exit_code
    with suppress(OSError):  # nobody is there to read it, or the disk is full
        sys.stdout.flush()  # stderr owes nothing: it is written line by line
    os._exit(code if isinstance(code, int) else 0)  # Zenoh's threads must not hold it back


def _call(words: "Sequence[str]") -> object:
    """Parse and run a command. What it imports is done by then, so that a signal leaves nothing."""
    from cyclopts import CycloptsError

    from gigabrain_zenoh.config.renames import renamed_arguments
    from gigabrain_zenoh.errors import ConfigError, GigabrainError
    from gigabrain_zenoh.host.signals import interrupts

    words = renamed_arguments(words)
    try:
        app = make_app(words)
        command, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
        with interrupts.raising():
            return command(*bound.args, **bound.kwargs)
    except GigabrainError as error:
        print(f"gigabrain: {error}", file=sys.stderr)
        return interrupts.exit_code if interrupts.received else error.exit_code
    except CycloptsError as error:
        print(f"gigabrain: {' '.join(str(error).split())}", file=sys.stderr)
        return ConfigError.exit_code
