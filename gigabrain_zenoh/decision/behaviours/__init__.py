"""Behaviours: their inputs and outcomes, and how they are loaded by name.

A behaviour is one module: its class, its `Config`, and the parameters that may change while it
runs. Other packages offer behaviours as entry points of the group `gigabrain.behaviours`.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol, cast

import msgspec
from msgspec import Meta, Struct

from gigabrain_schemas.base import Fraction, Pose
from gigabrain_schemas.brain import Intent, Objects, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.tasks import Goal, Task
from gigabrain_zenoh.config import loading
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.tasks.arm_steps import ArmAction, Held, Solid
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import expanded
from gigabrain_zenoh.plugins import load_plugin, plugin_names

GROUP = "gigabrain.behaviours"
SHIPPED = {  # name in a deployment file -> "module:class"
    "avoid": "gigabrain_zenoh.decision.behaviours.avoid:Avoid",
    "navigate": "gigabrain_zenoh.decision.behaviours:Navigate",
}

NAVIGATION_PACKAGES = ("numba", "py_trees")

SpeedLimit = Annotated[float, Meta(gt=0, le=10)]  # [m/s] or [rad/s]
# `visit`: a random reachable place; `approach`: in front of a target; `look`: search unseen space
DriveKind = Literal["goto", "explore", "visit", "approach", "look"]


class Target(Struct, frozen=True, kw_only=True):
    """An object or tag to drive to."""

    name: str  # shown to users, such as `can 3`
    x: float  # [m] in the map
    y: float  # [m]
    radius: float  # [m]
    yaw: float | None = None  # [rad], direction of a tag's normal
    away: float | None = None  # [m], from the body's centre to the target's; None: a small gap


class DriveCommand(Struct, frozen=True):
    """A request to drive somewhere."""

    number: int  # a new number is a new command, even for the same goal
    kind: DriveKind
    goal: Goal | None = None  # of `goto`
    target: Target | None = None  # of `approach`
    seek: int = 0  # of `look`: number of the search; a new search starts with nothing seen


class ArmCommand(Struct, frozen=True):
    """A request to move the arm."""

    number: int  # as in a DriveCommand
    do: ArmAction
    things: Mapping[str, Solid]  # around the arm


Command = DriveCommand | ArmCommand


class StepOutcome(Struct, frozen=True, kw_only=True):
    """Result of one step of a behaviour, and progress of the command that it carries out."""

    number: int = 0  # of the command; 0 without one
    state: Literal["running", "done", "failed"] = "running"
    activity: str = ""  # short name of what the robot does; each change is logged
    reason: str = ""  # shown to users
    held: bool = False  # the body ignores decision: the gate or an operator holds it
    progress: float = 0.0
    distance: float | None = None  # [m] left along the path
    eta: float | None = None  # [s]
    goal: Goal | None = None  # current destination
    path: tuple[tuple[float, float], ...] = ()  # [m] in the map, for drawing
    position_error: float | None = None  # [m] from the requested place
    heading_error: float | None = None  # [rad] from the requested heading
    holds: Held | None = None  # what the gripper holds after a command that is done
    placed: tuple[str, Solid] | None = None  # thing that this command put down, with its new place
    approach: Target | None = None  # thing that the body has to drive nearer to
    seek: str = ""  # class of a thing to look for elsewhere


class Idle(NamedTuple):
    """A reason to stand still: a short name, whose changes are logged, and a text for users."""

    activity: str
    reason: str


class WaitReason(StrEnum):
    """Reasons why the robot cannot drive by its map yet; the value is the text for users."""

    STARTING = "starting up"
    PERCEPTION_STARTING = "perception is starting up"
    NO_LOCALIZATION = "no localization; set perception: {mapping: slam} or {mapping: localize}"
    NOT_LOCALIZED = "the pose in the map is uncertain"
    NO_ODOMETRY_OF_POSE = "no odometry for the last pose in the map"
    NO_ODOMETRY_OF_SCAN = "no odometry for the scan"
    NO_MAP = "no map yet"


StepResult = tuple[Intent, StepOutcome]
Drive = Callable[[DriveCommand | None], StepResult]


@dataclass(frozen=True, kw_only=True, eq=False)
class Inputs:
    """Inputs of a behaviour at one scan."""

    world: WorldModel | None  # None while perception is silent
    pose: Pose  # in the odometry frame, at the same tick
    must_charge: bool = False  # the battery is nearly empty
    objects: Mapping[str, Objects] = field(default_factory=dict)  # by perceptor, if fresh
    # for behaviours with a NavigationConfig:
    command: DriveCommand | None = None  # of the task queue
    drive: Drive | None = None  # carries out a command: one step of the navigator


class Behaviour(Protocol):
    """Turns inputs into intents, one step per scan. It has a memory, but no clock and no bus."""

    Config: ClassVar[type[Struct]]  # a NavigationConfig, if it needs a map, goals and missions
    PARAMS: ClassVar[Mapping[str, str]]  # fields of Config that may change, and their valid values
    DEMO: ClassVar[Mapping[str, Any]]  # settings for a demonstration

    def __init__(self, config: Any) -> None: ...

    def configure(self, config: Any) -> None:
        """Replace the settings, and keep the memory."""
        ...

    def step(self, inputs: Inputs) -> StepResult:
        """Return the intent, and the outcome of `inputs.command` if there is one."""
        ...


class NavigationConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of a behaviour that drives by a map; perception must have `mapping` on."""

    max_linear_speed: SpeedLimit | None = None  # [m/s]; the body's own limit applies too
    # [m] beyond the body's width, in which obstacles are avoided where there is room; null: by the
    # body's shape
    inflation: Annotated[float, Meta(ge=0.05, le=3.0)] | None = None
    aggressiveness: Fraction = 0.5  # 0: gentle, with more room; 1: faster in tight places
    # paths through unknown cells; with `allow` also to goals beyond the map
    unknown_space: Literal["avoid", "allow", "forbid"] = "avoid"
    samples: Annotated[int, Meta(ge=64, le=20_000)] = 1000  # candidate plans per scan
    start: Literal["wait", "explore"] = "wait"  # explore, then visit places, until a task is added
    mission: str = ""  # file of a mission to start with instead; empty: none
    scripts: str = ""  # folder of programs that missions may run; empty: none


class Navigate:
    """Drives to goals by the map: passes each command of the task queue to the navigator."""

    Config = NavigationConfig
    PARAMS: ClassVar[Mapping[str, str]] = {
        "max_linear_speed": "a number above 0, up to 10 [m/s], or null for the body's limit alone",
        "inflation": "a number from 0.05 to 3 [m] beyond the body's width, or null",
        "aggressiveness": "a number from 0, gentle, to 1, quick in tight places",
    }
    DEMO: ClassVar[Mapping[str, Any]] = {"start": "explore"}

    def __init__(self, config: NavigationConfig) -> None:
        pass

    def configure(self, config: NavigationConfig) -> None:
        """Do nothing: the navigator keeps the settings."""

    def step(self, inputs: Inputs) -> StepResult:
        """Carry out the current command."""
        assert inputs.drive
        return inputs.drive(inputs.command)


def names() -> list[str]:
    """Return the names of all behaviours."""
    return plugin_names(SHIPPED, GROUP)


def load(name: str) -> type[Behaviour]:
    """Return the behaviour called `name`. Raises UnknownName, and ConfigError if it is broken."""
    found = load_plugin("behaviour", name, SHIPPED, GROUP, ("Config", "step"))
    return cast("type[Behaviour]", found)


def needs_map(name: str) -> bool:
    """Return whether a behaviour drives by a map. Raises UnknownName and ConfigError."""
    return issubclass(load(name).Config, NavigationConfig)


def settings_of(config: DecisionConfig) -> Any:
    """Return the configured behaviour's settings. Raises UnknownName and ConfigError."""
    kind, text = load(config.behaviour).Config, msgspec.json.encode(config.settings).decode()
    try:
        return loading.loads(text, kind, "settings")
    except ConfigError as error:
        problem = str(error).removeprefix("settings:1: ")
        raise ConfigError(f"decision.settings of {config.behaviour}: {problem}") from None


def check(config: DecisionConfig, path: Path | None = None) -> None:
    """Raise ConfigError if the behaviour cannot run with `config`; with the line in file `path`."""
    kind = load(config.behaviour).Config
    if path:
        loading.loads(loading.read(path), kind, str(path), at=("decision", "settings"))
    settings = settings_of(config)
    if not isinstance(settings, NavigationConfig):
        return
    for package in NAVIGATION_PACKAGES:
        if find_spec(package) is None:
            raise ConfigError(
                f"behaviour {config.behaviour} needs {package}; pip install 'gigabrain-zenoh[nav]'"
            )
    if settings.scripts and not expanded(settings.scripts).is_dir():
        raise ConfigError(
            f"scripts: no folder {settings.scripts!r}; "
            "expected the folder with the programs that missions may run",
            value=settings.scripts,
        )


def parse_settings(pairs: Iterable[str]) -> dict[str, Any]:
    """Return settings given as `NAME=VALUE`, with values as in YAML. Raises ConfigError."""
    found = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise ConfigError(f"--set: expected NAME=VALUE, got {pair!r}")
        found[name] = loading.loads(f"value: {value}", dict[str, Any], pair)["value"]
    return found


def battery_nearly_empty(verdict: SafetyState | None) -> bool:
    """Return whether safety requests that the robot stops and is charged."""
    return verdict is not None and any(w.code == "battery_return" for w in verdict.warnings)


def describe_goal(goal: Goal) -> str:
    """Return a goal as text: `(x, y)` or `(x, y, yaw rad)`."""
    yaw = "" if goal.yaw is None else f", {goal.yaw:.2f} rad"
    return f"({goal.x:.2f}, {goal.y:.2f}{yaw})"


def describe_end(task: Task) -> str:
    """Return the end of a task as text, with its reason and errors."""
    if task.state == "cancelled":
        return f"{task.id} was {task.reason or task.state}"  # the reason names who cancelled it
    errors = []
    if task.position_error is not None:
        errors.append(f"position error {task.position_error:.2f} m")
    if task.heading_error is not None:
        errors.append(f"heading error {task.heading_error:.2f} rad")
    measured = f" ({', '.join(errors)})" if errors else ""
    return f"{task.id} has {task.state}{f': {task.reason}' if task.reason else ''}{measured}"
