"""The table of processes: one row contains the data for start, settings and rights of a process.

A supervisor starts each as `python -m gigabrain_zenoh.launch.processes ABOUT`, with a
ProcessConfig in JSON on its standard input; ABOUT names it for ps(1). Packages offer processes as
entry points of the group `gigabrain.processes`; each is a ProcessType.
"""

import contextlib
import os
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
from msgspec import structs

from gigabrain_schemas.topics import (
    CMD_VEL,
    ENABLE,
    ESTOP,
    GOAL,
    MAP_SAVE,
    MISSION,
    POSE_SET,
    RELEASE,
    TASK_CHANGE,
    Role,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.config import router_config
from gigabrain_zenoh.config.renames import renamed_settings
from gigabrain_zenoh.config.settings import (
    ButtonConfig,
    CameraConfig,
    DecisionConfig,
    DriverConfig,
    EmulatorConfig,
    Endpoint,
    FoxgloveConfig,
    PageConfig,
    PerceptionConfig,
    ProcessConfig,
    RecognitionConfig,
    RecorderConfig,
    RelayConfig,
    Ros2Config,
    Ros2Link,
    RouterConfig,
)
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.body_settings import split
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.signals import interrupts
from gigabrain_zenoh.launch.own_processes import OWN, failing_on_bus, load_own, own_type
from gigabrain_zenoh.launch.process import ProcessPlace, ProcessType, run
from gigabrain_zenoh.plugins import load_plugin, plugin_names
from gigabrain_zenoh.runtime.connect import MakeBus
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.security.acl import FLEET_KEYS

if TYPE_CHECKING:
    from gigabrain_zenoh.launch.deployment import Deployment

GROUP = "gigabrain.processes"
OPERATED: tuple[Role, ...] = ("robot", "operator")
RELAYED = {"perception", "decision"}  # each runs once per robot, so there is at most one relay
ROS_WRITES = tuple(
    each.key
    for each in (
        CMD_VEL, ESTOP, RELEASE, ENABLE, GOAL, MISSION, TASK_CHANGE, POSE_SET, MAP_SAVE,
    )
) + FLEET_KEYS  # fmt: skip
NEEDS_NAMESPACE = (
    "ros2: free_fleet needs the robot's namespace; set `namespace:` in the deployment file, "
    "or leave free_fleet off"
)
NO_ROS_IDENTITY = (
    "ros2: ROS nodes have no keys for this router; name another router as `router:`, or use "
    "`transport: dds`"
)
NEVER_RELAYED = {"router", "driver"}  # a relay would hide the loss of the router from the body


def _router(deployment: "Deployment", place: ProcessPlace) -> RouterConfig:
    config = router_config(place.endpoint, place.state_dir)
    return structs.replace(config, watches=tuple(own_processes(deployment)))


def _relay(_: "Deployment", place: ProcessPlace) -> RelayConfig:
    """Return the relay's settings, which name the router it connects to."""
    return RelayConfig(router=place.endpoint.connect[-1], keys=place.endpoint.keys)


def _driver(deployment: "Deployment", place: ProcessPlace) -> DriverConfig:
    return DriverConfig(
        body=deployment.body,
        link=deployment.link,
        world=deployment.world,
        seed=deployment.seed,
        speed=deployment.speed,
        lockstep_timeout_s=deployment.lockstep_timeout_s,
        seconds=place.seconds,
        resume=deployment.resume,
        state_dir=str(place.state_dir),
        emulator=str(place.ports) if deployment.link == "emulated" else "",
        checkpoint=str(place.checkpoint) if deployment.link == "sim" else "",
        button=deployment.button is not None,
        cameras=deployment.cameras,
        robot=deployment.robot,
    )


def _emulator(deployment: "Deployment", place: ProcessPlace) -> EmulatorConfig:
    return EmulatorConfig(
        body=deployment.body,
        world=deployment.world,
        seed=deployment.seed,
        folder=str(place.ports),
        checkpoint=str(place.checkpoint),
        cameras=deployment.cameras,
        robot=split(deployment.robot)[1],
    )


def _camera(deployment: "Deployment", _: ProcessPlace) -> CameraConfig:
    return CameraConfig(
        body=deployment.body,
        link=deployment.link,
        seed=deployment.seed,
        robot=split(deployment.robot)[1],
    )


def _recognition(deployment: "Deployment", _: ProcessPlace) -> RecognitionConfig:
    return RecognitionConfig(recognizer=deployment.recognizer, tags=deployment.tags)


def _recorder(deployment: "Deployment", _: ProcessPlace) -> RecorderConfig:
    """Return the recorder's settings, with notes for replays: settings of the other processes."""
    replayed = {"perception": deployment.perception, "decision": deployment.decision}
    notes = {name: msgspec.json.encode(settings).decode() for name, settings in replayed.items()}
    plain = {"body": deployment.body, "link": deployment.link, "world": deployment.world}
    plain["speed"] = f"{deployment.speed:g}"
    notes |= plain | deployment.recorder.notes
    return structs.replace(deployment.recorder, notes=notes)


def _ros2(deployment: "Deployment", place: ProcessPlace) -> Ros2Config:
    return gateway_config(deployment.ros2 or Ros2Config(), place.endpoint)


def gateway_config(config: Ros2Config, endpoint: Endpoint) -> Ros2Config:
    """Return the gateway's settings for the robot at an endpoint.

    Raises ConfigError as `with_ros_router` does, and for free_fleet without a namespace.
    """
    if config.free_fleet and not endpoint.namespace:
        raise ConfigError(NEEDS_NAMESPACE)
    return with_ros_router(config, endpoint)


L = TypeVar("L", bound=Ros2Link)


def with_ros_router(config: L, endpoint: Endpoint) -> L:
    """Return settings for ROS with the robot's own router, unless they name another one.

    Raises ConfigError if the robot's router has keys.
    """
    if config.transport != "rmw_zenoh" or config.router:
        return config
    if endpoint.keys:
        raise ConfigError(NO_ROS_IDENTITY)
    return structs.replace(config, router=endpoint.connect[-1])


def _needs_ros2(deployment: "Deployment", here: set[str]) -> bool:
    """Return whether the gateway to ROS runs on the driver's host: unless `hosts` names it."""
    placed = any("ros2" in names for names in deployment.hosts.values())
    return deployment.ros2 is not None and "driver" in here and not placed


def _needs_relay(_: "Deployment", here: set[str]) -> bool:
    """Return whether a host with these processes runs a relay; never on Windows.

    A relay needs Unix sockets.
    """
    return sys.platform != "win32" and here >= RELAYED and not here & NEVER_RELAYED


def _needs_emulator(deployment: "Deployment", here: set[str]) -> bool:
    return deployment.link == "emulated" and "driver" in here


def _needs_button(deployment: "Deployment", here: set[str]) -> bool:
    """Return whether an e-stop button runs on the driver's host: unless `hosts` names it."""
    placed = any("button" in names for names in deployment.hosts.values())
    return deployment.button is not None and "driver" in here and not placed


def _needs_camera(deployment: "Deployment", here: set[str]) -> bool:
    """Return whether the camera process runs on the driver's host: unless `hosts` names it."""
    placed = any("camera" in names for names in deployment.hosts.values())
    return deployment.cameras and "driver" in here and not placed


def _needs_recognition(deployment: "Deployment", here: set[str]) -> bool:
    """Return whether recognition runs on perception's host: unless `hosts` names it."""
    placed = any("recognition" in names for names in deployment.hosts.values())
    wanted = deployment.cameras and deployment.recognition
    return wanted and "perception" in here and not placed


def _maps(deployment: "Deployment") -> bool:
    return deployment.perception.mapping != "off"


def _navigates(deployment: "Deployment") -> bool:
    from gigabrain_zenoh.decision.behaviours import needs_map  # few processes need it

    return needs_map(deployment.decision.behaviour)


PROCESSES: Mapping[str, ProcessType] = {
    "router": ProcessType(
        "gigabrain_zenoh.runtime.router:run",
        RouterConfig,
        derive=_router,
        default=True,
        after=(),
        stops=True,
        stop_last=True,
        roles=("robot", "router"),
        forks=True,
    ),
    "emulator": ProcessType(
        "gigabrain_drivers.emulators.process:run",
        EmulatorConfig,
        derive=_emulator,
        named=False,
        joins=_needs_emulator,
        stops=True,
        stop_last=True,
        roles=("robot",),
    ),
    "driver": ProcessType(
        "gigabrain_drivers.driver.process:run",
        DriverConfig,
        derive=_driver,
        default=True,
        after=("router", "emulator"),
        stops=True,
        roles=("robot",),
        forks=True,
    ),
    "camera": ProcessType(
        "gigabrain_drivers.cameras.process:run",
        CameraConfig,
        derive=_camera,
        joins=_needs_camera,
        optional=True,
        roles=("robot",),
    ),
    "perception": ProcessType(
        "gigabrain_zenoh.perception.node:run",
        PerceptionConfig,
        default=True,
        compiles=_maps,
        replayable=True,
        roles=("robot", "brain"),
        forks=True,
    ),
    "recognition": ProcessType(
        "gigabrain_zenoh.recognition.node:run",
        RecognitionConfig,
        derive=_recognition,
        joins=_needs_recognition,
        optional=True,
        roles=("robot", "brain"),
    ),
    "decision": ProcessType(
        "gigabrain_zenoh.decision.node:run",
        DecisionConfig,
        default=True,
        compiles=_navigates,
        replayable=True,
        roles=("robot", "brain"),
        forks=True,
    ),
    "relay": ProcessType(
        "gigabrain_zenoh.runtime.router:run_relay",
        RelayConfig,
        derive=_relay,
        named=False,
        joins=_needs_relay,
        after=(),
        stops=True,
        stop_last=True,
        roles=("robot", "brain"),
        forks=True,
    ),
    "control": ProcessType(
        "gigabrain_zenoh.control.node:run",
        default=True,
        stops=True,
        replayable=True,
        forks=True,
        roles=("robot",),
    ),
    "safety": ProcessType(
        "gigabrain_zenoh.safety.node:run",
        default=True,
        stops=True,
        replayable=True,
        forks=True,
        roles=("robot",),
    ),
    "page": ProcessType(
        "gigabrain_zenoh.ui.page.node:run",
        PageConfig,
        optional=True,
        looks_on=True,
        roles=OPERATED,
    ),
    "foxglove": ProcessType(
        "gigabrain_zenoh.ui.foxglove.node:run",
        FoxgloveConfig,
        optional=True,
        looks_on=True,
        roles=OPERATED,
    ),
    "ros2": ProcessType(
        "gigabrain_zenoh.gateway.node:run",
        Ros2Config,
        derive=_ros2,
        joins=_needs_ros2,
        optional=True,
        prompt=True,
        writes=ROS_WRITES,
    ),
    "recorder": ProcessType(
        "gigabrain_zenoh.recording.node:run",
        RecorderConfig,
        derive=_recorder,
        looks_on=True,
        roles=OPERATED,
    ),
    "button": ProcessType(
        "gigabrain_drivers.driver.button:run",
        ButtonConfig,
        joins=_needs_button,
        stops=True,
        roles=OPERATED,
    ),
}


def process_type(name: str) -> ProcessType:
    """Return the row of a process. Raises UnknownName, and ConfigError if it is broken."""
    found: ProcessType = load_plugin("process", name, PROCESSES, GROUP, ("run", "roles"))
    return found


def process_types() -> dict[str, ProcessType]:
    """Return all rows by name, also those of packages; skip broken packages."""
    rows = {}
    for name in plugin_names(PROCESSES, GROUP):
        with contextlib.suppress(ConfigError):  # raised again where a deployment names it
            rows[name] = process_type(name)
    return rows


def deployed_type(deployment: "Deployment", name: str) -> ProcessType:
    """Return the row of a process that `hosts` of a deployment names, also the user's own.

    Raises UnknownName and ConfigError.
    """
    return own_type(deployment, name) or process_type(name)


def own_processes(deployment: "Deployment") -> dict[str, ProcessType]:
    """Return the processes with their own identity on any host of a deployment, by name."""
    placed = (name for names in deployment.hosts.values() for name in names)
    rows = {name: deployed_type(deployment, name) for name in placed}
    return {name: row for name, row in rows.items() if row.own}


def grants(deployment: "Deployment | None" = None) -> dict[str, tuple[str, ...]]:
    """Return the keys that processes with their own identity write, by name."""
    rows = {name: row for name, row in process_types().items() if row.own}
    if deployment:
        rows |= own_processes(deployment)
    return {name: row.writes for name, row in rows.items()}


def names_by_role() -> dict[str, tuple[str, ...]]:
    """Return the names of the processes that an identity of each role may run."""
    names: dict[str, tuple[str, ...]] = {}
    for name, row in process_types().items():
        for role in row.roles:
            names[role] = (*names.get(role, ()), name)
    return names


def node_of(config: ProcessConfig) -> Node:
    """Return the node of a process bound to its settings. Raises ValidationError."""
    settings: dict[str, Any] = renamed_settings(config.settings, config.name)
    return process_type(config.name).node(settings)


def load_process(config: ProcessConfig) -> tuple[ProcessType, Node]:
    """Return the row of a process, and its node. Raises ValidationError and ConfigError."""
    if config.module or config.perceptor:
        return OWN, failing_on_bus(lambda: load_own(config)[1])
    row = process_type(config.name)
    if row.own:
        return row, failing_on_bus(lambda: node_of(config))
    this_process.open_no_window()
    return row, node_of(config)


def run_process(config: ProcessConfig, make_bus: MakeBus = Bus) -> int:
    """Run one process until it ends, and return its exit code."""
    return run(config, load_process, make_bus)


def main() -> None:
    """Run a supervised process, configured by its standard input, and exit."""
    this_process.set_up()
    code = run_supervised(sys.stdin.buffer.read())
    sys.stdout.flush()
    os._exit(code)  # Zenoh's threads must not keep a finished process alive


def run_supervised(config: str | bytes) -> int:
    """Run the process with a ProcessConfig in JSON, and return its exit code."""
    this_process.show_stack_on_request()
    interrupts.install()
    return run_process(msgspec.json.decode(config, type=ProcessConfig))


if __name__ == "__main__":
    main()
