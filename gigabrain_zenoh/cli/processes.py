"""Commands that run one process each, to start a robot by hand or on several hosts."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
from cyclopts import Parameter
from msgspec import structs

from gigabrain_zenoh.bus.zenoh.config import router_config, secured, session_config
from gigabrain_zenoh.cli.options import Level, Seed, World, check_names, checked, print_progress
from gigabrain_zenoh.config.settings import (
    ButtonConfig,
    DecisionConfig,
    DriverConfig,
    Endpoint,
    LinkName,
    ProcessConfig,
    Resume,
)
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import run_folders
from gigabrain_zenoh.host.files import expanded
from gigabrain_zenoh.host.network import exposed, reached_at
from gigabrain_zenoh.launch.merging import value_layers
from gigabrain_zenoh.launch.processes import grants, names_by_role, process_type, run_process
from gigabrain_zenoh.runtime.running import announced, find_endpoint
from gigabrain_zenoh.security.identity_files import identity_in

ROUTER = "tcp/127.0.0.1:7447"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class HostOptions:
    """Identity and logging of a process."""

    namespace: str = ""
    "Namespace of the robot, where one router serves several robots."
    keys: Path | None = None
    "Folder of this host's identity, if the robot has keys."
    run_dir: Path | None = None
    "Write a log file to this folder."
    level: Level = "info"
    "Lowest level to log."

    @property
    def folder(self) -> str:
        """Return the folder of the identity; empty for none."""
        return str(expanded(self.keys).absolute()) if self.keys else ""

    def run_at(self, endpoint: Endpoint, name: str, settings: dict[str, Any]) -> int:
        """Run the process `name` until a signal; return its exit code."""
        return run_process(
            ProcessConfig(
                name=name,
                endpoint=endpoint,
                settings=settings,
                run_dir=str(self.run_dir) if self.run_dir else None,
                level=self.level,
            )
        )


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ProcessOptions(HostOptions):
    """Connection and logging of a process."""

    connect: str = ROUTER
    "Zenoh endpoint of the router."

    def run(self, name: str, settings: dict[str, Any]) -> int:
        """Connect, and run the process `name` until a signal; return its exit code."""
        endpoint = find_endpoint(self.connect, self.namespace, self.folder)
        session_config(endpoint)  # raises for a wrong address, before starting
        return self.run_at(endpoint, name, settings)


ALONE, LOCAL = HostOptions(), ProcessOptions()


def router(
    *,
    listen: tuple[str, ...] = (ROUTER,),
    fleet: tuple[str, ...] = (),
    insecure: bool = False,
    process: HostOptions = ALONE,
) -> int:
    """Run the router that connects the other processes. Tools on this machine find it.

    Example: gigabrain router --listen tcp/127.0.0.1:7447

    Args:
        listen: Zenoh endpoint to listen on; may be given again.
        fleet: Namespace of a robot that it serves, with --keys; may be given again.
        insecure: Listen beyond loopback without keys: anybody on the network can then drive.
    """
    keys = process.folder
    if keys:
        identity_in(Path(keys))
    namespace = process.namespace
    names = names_by_role() if keys else {}
    at = Endpoint(listen=listen, namespace=namespace, keys=keys, fleet=fleet)
    endpoint = secured(structs.replace(at, names=names, grants=grants()))
    if not keys and not insecure:
        _refuse_exposed(listen)
    settings = router_config(endpoint, run_folders.state_dir() / "robots" / (namespace or "router"))
    local = reached_at(endpoint.listen[0])
    if keys:  # clients with keys accept no IPv6 address
        local = local.replace("/[::1]:", "/localhost:")
    client = Endpoint(connect=(local,), namespace=namespace, keys=keys)
    with announced(namespace or "router", client):
        return process.run_at(endpoint, "router", msgspec.to_builtins(settings))


def run(name: str, /, *, set: tuple[str, ...] = (), process: ProcessOptions = LOCAL) -> int:
    """Run any process by its name, also one that an installed package offers.

    Example: gigabrain node run recorder --set folder=/data

    Args:
        name: Name of the process, as in `hosts` of a deployment file.
        set: Setting of the process, as NAME=VALUE; may be given again.
    """
    settings, kind = behaviours.parse_settings(set), process_type(name).settings
    if kind:
        settings = msgspec.to_builtins(value_layers(settings, "--set").convert(kind))
    elif settings:
        raise ConfigError(f"--set: {name} has no settings")
    return process.run(name, settings)


def new(
    name: str,
    *,
    kind: Literal["process", "perceptor", "behaviour"] = "process",
    folder: Path = Path(),
) -> None:
    """Create the package of a process, perceptor or behaviour, with a test that passes.

    Example: gigabrain process new lamp

    Existing files are not overwritten.

    Args:
        name: Its name: lower-case letters, digits, underscores.
        kind: A whole process, a perception step, or a behaviour that chooses the motion.
        folder: Where to create the package's folder.
    """
    from gigabrain_zenoh.qa.scaffold.packages import write_package

    print(f"{write_package(kind, name, folder)}: README.md describes the next steps")


def perception(*, process: ProcessOptions = LOCAL) -> int:
    """Run perception: it turns scans into a model of the surroundings.

    Example: gigabrain perception --connect tcp/192.168.1.10:7447
    """
    return process.run("perception", {})


def decision(
    *,
    behaviour: str = "avoid",
    set: tuple[str, ...] = (),
    scripts: Path | None = None,
    state_dir: Path | None = None,
    process: ProcessOptions = LOCAL,
) -> int:
    """Run decision: it chooses what to do in these surroundings.

    Example: gigabrain decision --set turn=clearer

    Args:
        behaviour: Behaviour that drives: `avoid` or `navigate`.
        set: Setting of the behaviour, as NAME=VALUE; may be given again.
        scripts: Folder of the programs that missions may run.
        state_dir: Folder for the tasks, which survive a restart.
    """
    values = behaviours.parse_settings(set)
    if scripts:
        values["scripts"] = str(scripts.absolute())
    settings = DecisionConfig(
        behaviour=behaviour,
        settings=values,
        state_dir=_state_folder(state_dir, process.namespace or "decision"),
    )
    behaviours.check(settings)  # raises for a wrong name, before connecting
    return process.run("decision", msgspec.to_builtins(settings))


def control(*, process: ProcessOptions = LOCAL) -> int:
    """Run control: it turns intents into smooth commands.

    Example: gigabrain control
    """
    return process.run("control", {})


def safety(*, process: ProcessOptions = LOCAL) -> int:
    """Run safety: it monitors all processes and limits the speed.

    Example: gigabrain safety
    """
    return process.run("safety", {})


def driver(
    name: str,
    *,
    link: LinkName = "sim",
    world: World = "arena",
    seed: Seed = 0,
    speed: float = 1.0,
    resume: Resume = "manual",
    cameras: bool = False,
    ports: Path | None = None,
    state_dir: Path | None = None,
    process: ProcessOptions = LOCAL,
) -> int:
    """Run the driver of a robot.

    Example: gigabrain driver run turtlebot3_waffle --world house --resume auto

    Args:
        name: Name of the robot, or path of its YAML file; see `gigabrain robots`.
        link: How to reach the robot: simulated, emulated or real.
        speed: Real-time factor. If it is not 1, simulated time waits for the brain.
        resume: Resume after a stop once its cause is gone: by itself, or when enabled.
        cameras: Use the robot's cameras; run them with `gigabrain node run camera`.
        ports: Folder of the emulator's ports, for `--link emulated`.
        state_dir: Folder that keeps the cause of a latch across restarts.
    """
    from gigabrain_drivers.driver.catalog import load_link
    from gigabrain_drivers.driver.robot import Run

    values = {
        "body": name,
        "link": link,
        "world": world,
        "seed": seed,
        "speed": speed,
        "resume": resume,
        "cameras": cameras,
        "emulator": str(ports.absolute()) if ports else "",
        "state_dir": _state_folder(state_dir, process.namespace or Path(name).stem),
    }
    settings = checked(values, DriverConfig)
    if link != "real":
        check_names(worlds=[world])
    load_link(
        name, Run(folder=Path(), link=link, cameras=cameras)
    )  # raises for a wrong name, before connecting
    return process.run("driver", msgspec.to_builtins(settings))


def button(*, port: str, process: ProcessOptions = LOCAL) -> int:
    """Run an e-stop button: a normally closed contact between TX and RX of a serial adapter.

    Example: gigabrain button --port usb:0403:6001

    Args:
        port: Serial adapter: a path, or usb:VID:PID[:SERIAL].
    """
    from gigabrain_drivers.links.serial_link import describe_absent

    settings = checked({"port": port}, ButtonConfig)
    if problem := describe_absent(port):  # the process itself reports it only after connecting
        print_progress(f"gigabrain: {problem} Waiting for it.")
    return process.run("button", msgspec.to_builtins(settings))


def _refuse_exposed(listen: tuple[str, ...]) -> None:
    try:
        address = exposed(listen)
    except ValueError as error:
        raise ConfigError(f"--listen: {error}") from None
    if address:
        raise ConfigError(
            f"--listen: anybody on the network can reach {address}; "
            "add --keys, use a loopback address, or add --insecure"
        )


def _state_folder(chosen: Path | None, name: str) -> str:
    return str(chosen or run_folders.state_dir() / "robots" / name)
