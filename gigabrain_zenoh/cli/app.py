"""The table of commands. `gigabrain --help` imports this module alone, so it stays light."""

# these two are already loaded: signal handlers must be installed before slow imports
import os
import sys

TYPE_CHECKING = False  # as in `typing`
if TYPE_CHECKING:
    from collections.abc import Sequence

    from cyclopts import App

MODULES = "gigabrain_zenoh.cli"

# command: its function, and one line of help
COMMANDS = {
    "demo": ("demo:demo", "Run a simulated robot on this machine, until Ctrl-C."),
    "up": ("demo:up", "Run the processes of a deployment file on this host, until Ctrl-C."),
    "robots": ("demo:robots", "List the known robots."),
    "worlds": ("demo:worlds", "List the simulated worlds."),
    "render": ("demo:render", "Draw a robot in its world to a PNG file."),
    "world add": ("world:add", "Add an obstacle or a person to the simulated world."),
    "world remove": ("world:remove", "Remove an object."),
    "world list": ("world:list_", "List the added objects, and where the robot is."),
    "goto": (
        "task:goto",
        "Send the robot to a place, a thing or a tag, and wait for it.",
    ),
    "explore": ("task:explore", "Explore until the map is complete."),
    "patrol": ("task:patrol", "Visit the places of a file in turn."),
    "mission": ("task:mission", "Run a mission from a file."),
    "pick": ("arm:pick_seen", "Pick up a thing that the camera recognises."),
    "task list": ("task:list_", "List the current task, the queue and the last tasks."),
    "task cancel": ("task:cancel", "Cancel the current task, or another one."),
    "task pause": ("task:pause", "Pause a task."),
    "task resume": ("task:resume", "Resume a paused task."),
    "estop": ("gate:estop", "Stop the robot at once, and latch it."),
    "release": ("gate:release", "Release a latched robot."),
    "enable": ("gate:enable", "Let the robot's brain drive."),
    "audit": ("gate:audit", "Show who did what to the robot."),
    "teleop": ("views:teleop", "Drive the robot by keyboard, gamepad or a second arm."),
    "page": ("views:page", "Serve the operator page: the robot in a browser."),
    "view": ("views:view", "Open a live window of the simulation, or save a picture of it."),
    "foxglove": ("views:foxglove", "Show the robot live in Foxglove or Lichtblick."),
    "ros2": ("ros2:ros2", "Run the gateway to ROS 2: the robot becomes a node there."),
    "ros2 topics": ("ros2:topics", "List topics of ROS, with the robot's keys beside them."),
    "ros2 pass": ("ros2:pass_", "Pass messages between a key and a ROS topic, without code."),
    "why": ("diagnose:why", "Say why the robot does not move."),
    "doctor": ("diagnose:doctor", "Check this machine and the robot, and say what to fix."),
    "top": ("node:top", "Watch processes and topics live."),
    "log": ("diagnose:log", "Show the logs of the processes."),
    "graph": ("node:graph", "Draw which process sends what to which."),
    "topic list": ("topic:list_", "List topics, rates, senders and receivers."),
    "topic echo": ("topic:echo", "Print messages as they arrive."),
    "topic hz": ("topic:hz", "Measure message rates."),
    "topic bw": ("topic:bw", "Measure bandwidth."),
    "topic delay": ("topic:delay", "Measure the delay of messages."),
    "topic info": ("topic:info", "Describe one topic."),
    "topic pub": ("topic:pub", "Publish a message."),
    "node list": ("node:list_", "List the running processes."),
    "node info": ("node:info", "Describe one process."),
    "node run": ("processes:run", "Run any process by its name."),
    "param list": ("node:list_params", "List the parameters that can be changed at run time."),
    "param get": ("node:get_param", "Print one parameter."),
    "param set": ("node:set_param", "Change one parameter."),
    "param save": ("node:save_params", "Save the changed parameters to a file."),
    "config": ("config:config", "Print all settings, and where each comes from."),
    "map list": ("map:list_", "List the saved maps of this machine."),
    "map load": ("map:load", "Let a running robot use a saved map."),
    "map save": ("map:save", "Save the map that the robot makes."),
    "map info": ("map:info", "Check a saved map, and print its size."),
    "place list": ("zone:list_", "List the named places and zones of the robot's map."),
    "place add": ("zone:add", "Name a place of the map: where the robot is, or a given one."),
    "place remove": ("zone:remove", "Remove a named place or a zone."),
    "zone add": ("zone:add_zone", "Add a keep-out zone, a speed zone or a one-way lane."),
    "arm state": ("arm:state", "Show the joints: position, speed, effort, temperature, range."),
    "arm jog": ("arm:jog", "Move one joint by degrees or millimetres."),
    "arm home": ("arm:home", "Move the arm to its home posture."),
    "arm goto": ("arm:goto", "Move the tool to a point."),
    "arm pick": ("arm:pick", "Pick a thing up."),
    "arm place": ("arm:place", "Put down what the gripper holds."),
    "arm press": ("arm:press", "Press a place with the closed gripper."),
    "arm hand-over": ("arm:hand_over", "Hand what the gripper holds to a person."),
    "arm limp": ("arm:limp", "Switch joint torque off, to move the joints by hand."),
    "arm hold": ("arm:hold", "Hold limp joints again, where they are."),
    "objects": ("objects:objects", "List the things and tags that the cameras have recognised."),
    "pose": ("objects:pose", "Set the robot's pose in its map."),
    "record": ("bag:record", "Record a robot's messages to an MCAP file, until Ctrl-C."),
    "bag info": ("bag:info", "Describe a recording."),
    "bag check": ("bag:check", "Check that a recording is complete."),
    "bag recover": ("bag:recover", "Copy what is readable of a damaged recording."),
    "bag play": ("bag:play", "Publish a recording again."),
    "bag plot": ("bag:plot", "Plot values of a recording over time, as a PNG."),
    "bag convert": ("bag:convert", "Convert a recording to CSV tables or a LeRobot dataset."),
    "replay": ("bag:replay", "Feed a recording to a process, and compare its output."),
    "router": ("processes:router", "Run the router that connects the other processes."),
    "perception": ("processes:perception", "Run perception."),
    "decision": ("processes:decision", "Run decision."),
    "control": ("processes:control", "Run control."),
    "safety": ("processes:safety", "Run safety."),
    "button": ("processes:button", "Run an e-stop button on a serial adapter."),
    "driver run": ("processes:driver", "Run the driver of a robot."),
    "driver new": ("driver:new", "Create the package of a new driver."),
    "driver test": ("driver:test", "Run the conformance checks on a driver."),
    "driver calibrate": ("driver:calibrate", "Calibrate an arm by moving its joints by hand."),
    "driver bringup": ("driver:bringup", "Compare a ROS 2 robot with its file."),
    "driver trace": ("driver:trace", "Print the bytes on a robot's line, decoded."),
    "emulate": ("driver:emulate", "Emulate a robot's hardware on serial and TCP ports."),
    "process new": ("processes:new", "Create the package of a process, perceptor or behaviour."),
    "keys new": ("keys:new", "Create the authority of a fleet, which issues identities."),
    "keys issue": ("keys:issue", "Issue an identity: a folder to copy to its host."),
    "keys revoke": ("keys:revoke", "Revoke all identities of a role."),
    "keys list": ("keys:identities", "List identities, and when they expire."),
    "keys zenohd": ("keys:zenohd", "Print a zenohd configuration for a larger site."),
    "faults": ("faults:faults", "Inject faults, and check that the robot stops."),
    "proxy": ("faults:proxy", "Emulate a bad network in front of a router or a robot's port."),
    "bench chain": ("bench:chain", "Measure scan-to-command latency."),
    "bench stack": ("bench:stack", "Measure CPU, memory and start-up time."),
    "bench robots": ("bench:robots", "Have several robots explore at once on this machine."),
    "bench estop": ("bench:estop", "Time the e-stop."),
    "bench bodies": ("bench:bodies", "Drive all robots in turn with one brain."),
    "bench plan": ("bench:plan", "Time and check global planning."),
    "bench slam": ("bench_navigation:slam", "Measure map errors on laser logs or in simulation."),
    "bench goals": ("bench_navigation:goals", "Explore, then drive to random goals."),
    "bench eyes": ("bench_eyes:eyes", "Measure obstacle contours of cameras."),
    "bench cameras": ("bench_eyes:cameras", "Measure what cameras cost a whole robot."),
    "bench clutter": ("bench_eyes:clutter", "Drive to goals past obstacles a lidar misses."),
    "bench objects": ("bench_eyes:objects", "Measure what a robot remembers of things."),
    "bench fetch": ("bench_hands:fetch", "Fetch a can from another room."),
    "bench reach": ("bench_hands:reach", "Have an arm go to random goals near its body."),
    "bench joints": ("bench_hands:joints", "Have each joint of an arm follow a sine and a step."),
    "bench hands": ("bench_hands:hands", "Pick things up and put them down with an arm."),
    "bench barn": ("bench_navigation:barn", "Run the BARN and DynaBARN benchmarks."),
    "precompile": ("map:precompile", "Compile mapping and navigation for a quick first start."),
    "schema export": ("topic:export", "Write JSON Schema of every message."),
    "completion": ("options:completion", "Print a shell completion script."),
}
GROUPS = {
    "driver": "Run, create and check drivers.",
    "process": "Create processes of your own.",
    "keys": "Issue and revoke identities.",
    "bag": "Read, play and convert recordings.",
    "topic": "Inspect and publish messages.",
    "node": "Inspect and run processes.",
    "task": "List and control the robot's tasks.",
    "param": "Read and change parameters at run time.",
    "world": "Change the simulated world while it runs.",
    "map": "Save, list, load and check maps.",
    "place": "List and change the named places of a map.",
    "zone": "Add zones to a map.",
    "arm": "Show and move the joints of an arm.",
    "bench": "Run benchmarks.",
    "schema": "Export message definitions.",
}
SUPERVISING = {"demo", "up"}  # these start a robot's processes
# commands with subcommands
PARENTS = COMMANDS.keys() & {command.rpartition(" ")[0] for command in COMMANDS}


def make_app(chosen: "Sequence[str]" = ()) -> "App":
    """Return the app with all commands.

    A command whose name is among the words `chosen` shows its full help. The others show their line
    of the table, so that their modules are not imported. A command of PARENTS gets its own options
    only if it is chosen.
    """
    from importlib import import_module

    from cyclopts import App, Parameter

    from gigabrain_zenoh.cli.options import check_numbers, default_text

    app = App(
        name="gigabrain",
        help="A robot brain of three systems that any body can wear.",
        help_format="plaintext",  # the default, Markdown, takes twice as long to start
        version=_version,
        config=check_numbers,
        default_parameter=Parameter(negative=(), show_default=default_text),
    )
    groups = {name: App(name=name, help=about) for name, about in GROUPS.items()}
    for group in groups.values():
        app.command(group)
    for command, (function, summary) in COMMANDS.items():
        group_name, _, name = command.rpartition(" ")
        group = groups.get(group_name, app)
        shown = None if name in chosen else summary
        if command not in PARENTS:
            group.command(f"{MODULES}.{function}", name=name, help=shown)
            continue
        parent = groups[command] = App(name=name, help=shown)
        if name in chosen:
            module, _, attribute = function.partition(":")
            parent.default(getattr(import_module(f"{MODULES}.{module}"), attribute))
        group.command(parent)
    return app


def _version() -> str:
    from gigabrain_zenoh.plugins import package_version  # slow import, for --version alone

    return package_version()


def main() -> None:
    """Run the `gigabrain` command, and exit with its exit code."""
    try:
        from contextlib import suppress

        from gigabrain_zenoh.host.signals import interrupts
        from gigabrain_zenoh.host.this_process import multiply_in_one_thread, open_no_window

        _open_standard_streams()
        interrupts.install()
        multiply_in_one_thread()
        open_no_window()
    except KeyboardInterrupt:
        os._exit(130)
    try:
        code = _call(sys.argv[1:])
        with suppress(BrokenPipeError):
            sys.stdout.flush()  # stderr is written line by line
    except KeyboardInterrupt:
        code = interrupts.exit_code
    except BrokenPipeError:  # the reader is gone, as in `gigabrain robots | head -1`
        code = 1
    except Exception as error:  # after a signal, errors are not shown
        if not interrupts.received and not _report_full_disk(error):
            raise
        code = interrupts.exit_code if interrupts.received else 1
    with suppress(OSError):  # the reader is gone, or the disk is full
        sys.stdout.flush()
    os._exit(code if isinstance(code, int) else 0)  # without waiting for Zenoh's threads


def _open_standard_streams() -> None:
    """Open closed streams, as of `gigabrain up FILE >&-`, before other files get their numbers."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    sys.stdin = sys.stdin or os.fdopen(0)
    sys.stdout = sys.stdout or os.fdopen(1, "w")
    sys.stderr = sys.stderr or os.fdopen(2, "w")


def _report_full_disk(error: Exception) -> bool:
    """Print a message if the disk of the output is full; return False for any other `error`."""
    from gigabrain_zenoh.host.files import FULL, file_problem

    if not isinstance(error, OSError) or error.errno not in FULL:
        return False
    print(f"gigabrain: cannot write: {file_problem(error)}", file=sys.stderr)
    return True


def _call(words: "Sequence[str]") -> object:
    """Parse and run a command. Signals raise only after its imports, so they interrupt none."""
    from cyclopts import CycloptsError

    from gigabrain_zenoh.config.renames import renamed_arguments
    from gigabrain_zenoh.errors import ConfigError, GigabrainError
    from gigabrain_zenoh.host.escaping import printable
    from gigabrain_zenoh.host.signals import interrupts

    if {*words[:1]} & SUPERVISING and not {*words} & {"--help", "-h"}:
        from gigabrain_zenoh.runtime.forking import start_early

        start_early("gigabrain_zenoh.launch.shared")
    try:
        words, notices = renamed_arguments(words)
        app = make_app(words)
        command, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
        for notice in notices:
            print(notice, file=sys.stderr)
        with interrupts.raising():
            return command(*bound.args, **bound.kwargs)
    except GigabrainError as error:
        print(f"gigabrain: {printable(error)}", file=sys.stderr)
        return interrupts.exit_code if interrupts.received else error.exit_code
    except CycloptsError as error:
        from gigabrain_zenoh.cli.options import usage_error

        print(f"gigabrain: {usage_error(error)}", file=sys.stderr)
        return ConfigError.exit_code
    except UnicodeEncodeError:
        wrong = next((word for word in words if not _is_text(word)), None)
        if wrong is None:
            raise
        print(f"gigabrain: '{printable(wrong)}': expected UTF-8 text", file=sys.stderr)
        return ConfigError.exit_code


def _is_text(word: str) -> bool:
    """Return whether an argument, which may be any bytes of the system, is UTF-8 text."""
    return word == word.encode(errors="replace").decode()
