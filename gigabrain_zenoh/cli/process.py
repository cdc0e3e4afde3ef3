"""One command per process, for whoever starts them one by one, or on several hosts."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from cyclopts import Parameter

from gigabrain_zenoh.bus.zenoh.config import router_config, secured
from gigabrain_zenoh.cli.checked import checked
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
from gigabrain_zenoh.host.network import exposed, reached_at
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.launch.processes import run_process
from gigabrain_zenoh.runtime.running import announced, find_endpoint
from gigabrain_zenoh.security.identity_files import identity_in

ROUTER = "tcp/127.0.0.1:7447"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Place:
    """Where a process meets the others, and where it logs."""

    connect: str = ROUTER
    "The router's Zenoh endpoint."
    namespace: str = ""
    "The robot's own part of the key space, where one router serves several robots."
    keys: Path | None = None
    "The folder of this host's identity, for a router that wants one."
    run_dir: Path | None = None
    "Write a log file into this folder."
    level: Literal["debug", "info", "warning", "error"] = "info"
    "The least level of what is logged."


HERE = Place()


def router(
    *,
    listen: tuple[str, ...] = (ROUTER,),
    fleet: tuple[str, ...] = (),
    insecure: bool = False,
    place: Annotated[Place, Parameter(show=False)] = HERE,
) -> int:
    """Start the router that joins the other processes. Tools find it as they find `up` and `demo`.

    Example: gigabrain router --listen tcp/127.0.0.1:7447

    Parameters
    ----------
    listen
        The Zenoh endpoints to listen on.
    fleet
        The namespaces of the robots that it serves, where it has keys.
    insecure
        Let anybody on the network drive: listen beyond loopback without keys.
    """
    keys = _keys(place)
    if keys:
        identity_in(Path(keys))
    endpoint = secured(Endpoint(listen=listen, namespace=place.namespace, keys=keys, fleet=fleet))
    if not keys and not insecure:
        _refuse_exposed(listen)
    settings = router_config(endpoint, state_dir() / "robots" / (place.namespace or "router"))
    here = Endpoint(connect=(reached_at(listen[0]),), namespace=place.namespace, keys=keys)
    with announced(place.namespace or "router", secured(here)):
        return _run("router", place, msgspec.to_builtins(settings), endpoint)


def perception(*, place: Place = HERE) -> int:
    """Start perception: scans become what is round the robot.

    Example: gigabrain perception --connect tcp/192.168.1.10:7447
    """
    return _run("perception", place, {})


def decision(
    *,
    behaviour: str = "avoid",
    set: tuple[str, ...] = (),
    scripts: Path | None = None,
    remember: Path | None = None,
    place: Place = HERE,
) -> int:
    """Start decision: what is round the robot becomes what to do.

    Example: gigabrain decision --set turn=clearer

    Parameters
    ----------
    behaviour
        What it does.
    set
        A setting of the behaviour, as NAME=VALUE; may be repeated.
    scripts
        The folder of the programs that missions may run.
    remember
        The folder for what must survive a restart: what it is to do.
    """
    values = behaviours.parse_settings(set)
    if scripts:
        values["scripts"] = str(scripts.absolute())
    settings = DecisionConfig(
        behaviour=behaviour,
        settings=values,
        state_dir=str(remember or state_dir() / "robots" / (place.namespace or "decision")),
    )
    behaviours.check(settings)
    return _run("decision", place, msgspec.to_builtins(settings))


def control(*, place: Place = HERE) -> int:
    """Start control: what to do becomes smooth commands.

    Example: gigabrain control
    """
    return _run("control", place, {})


def safety(*, place: Place = HERE) -> int:
    """Start safety: it listens to all and says how fast the body may move.

    Example: gigabrain safety
    """
    return _run("safety", place, {})


def driver(
    name: str,
    *,
    link: LinkName = "sim",
    world: str = "arena",
    seed: int = 0,
    speed: float = 1.0,
    resume: Resume = "manual",
    ports: Path | None = None,
    remember: Path | None = None,
    place: Place = HERE,
) -> int:
    """Start the driver of a body.

    Example: gigabrain driver run turtlebot3_waffle --world house --resume auto

    Parameters
    ----------
    name
        A known robot, or the path of a robot's YAML file.
    link
        How to reach it.
    world
        Where a simulated one drives.
    seed
        For the start pose and the noise of a simulated one.
    speed
        Simulated over real time; other than 1, time waits for the brain.
    resume
        Whether it goes on by itself after a stop that has passed.
    ports
        The folder of the emulator's ports, where the link is `emulated`.
    remember
        The folder for what must survive a restart: what latched it.
    """
    from gigabrain_drivers.driver.catalog import load_robot

    label = place.namespace or Path(name).stem
    values = {
        "body": name,
        "link": link,
        "world": world,
        "seed": seed,
        "speed": speed,
        "resume": resume,
        "emulator": str(ports.absolute()) if ports else "",
        "state_dir": str(remember or state_dir() / "robots" / label),
    }
    settings = checked(values, DriverConfig)
    load_robot(name)  # as above
    return _run("driver", place, msgspec.to_builtins(settings))


def button(*, port: str, place: Place = HERE) -> int:
    """Start an e-stop button: a normally closed contact between TX and RX of a serial adapter.

    Example: gigabrain button --port usb:0403:6001

    Parameters
    ----------
    port
        The adapter: a path, or usb:VID:PID[:SERIAL].
    """
    from gigabrain_drivers.links.ports import absent

    settings = checked({"port": port}, ButtonConfig)
    if problem := absent(port):
        # the process itself says so only where it has a robot to stop
        print(f"gigabrain: {problem} Waiting for it.", file=sys.stderr)
    return _run("button", place, msgspec.to_builtins(settings))


def _refuse_exposed(listen: tuple[str, ...]) -> None:
    try:
        seen = exposed(listen)
    except ValueError as error:
        raise ConfigError(f"--listen: {error}") from None
    if seen:
        raise ConfigError(
            f"--listen: {seen} can be reached by anybody on the network; name --keys, "
            "use a loopback address, or say --insecure"
        )


def _keys(place: Place) -> str:
    return str(place.keys.expanduser().absolute()) if place.keys else ""


def _run(
    name: str, place: Place, settings: dict[str, Any], endpoint: Endpoint | None = None
) -> int:
    return run_process(
        ProcessConfig(
            name=name,
            endpoint=endpoint or find_endpoint(place.connect, place.namespace, _keys(place)),
            settings=settings,
            run_dir=str(place.run_dir) if place.run_dir else None,
            level=place.level,
        )
    )
