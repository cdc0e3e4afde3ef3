"""What decision can do. Adding a behaviour means a module and a line in BEHAVIOURS."""

import importlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, ClassVar, Protocol, cast

import msgspec

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.errors import ConfigError, unknown

if TYPE_CHECKING:
    from gigabrain_zenoh.decision.behaviours.bearings import Bearings


class Situation(msgspec.Struct, frozen=True):
    """What a behaviour may look at."""

    world: WorldModel | None  # None while perception is silent
    pose: Pose  # odometry of the same tick
    must_charge: bool = False  # safety says that the battery is nearly empty
    bearings: "Bearings | None" = None  # for a behaviour that is sent to places


def must_charge(verdict: SafetyState | None) -> bool:
    """Whether safety wants the robot to come to rest and be charged."""
    return verdict is not None and any(w.code == "battery_return" for w in verdict.warnings)


class Behaviour(Protocol):
    """Turns one situation after the other into intents. It keeps its own memory, and no clock."""

    SETTINGS: ClassVar[frozenset[str]]  # the fields of DecisionConfig that it goes by
    PARAMS: ClassVar[Mapping[str, str]]  # those that may change while it runs: what is expected

    def __init__(self, config: DecisionConfig) -> None: ...

    def configure(self, config: DecisionConfig) -> None:
        """Go by other settings from now on, and keep what it remembers."""
        ...

    def step(self, situation: Situation) -> Intent:
        """What to do now."""
        ...


class Senses(Protocol):
    """What a behaviour goes by beside the world: hears it, and hands back what became of it."""

    async def warm_up(self) -> None:
        """Whatever takes its time, before anything drives."""
        ...

    def see(self, state: RobotState) -> None:
        """Take note of each state."""
        ...

    def situation(
        self, state: RobotState, world: WorldModel | None, verdict: SafetyState | None
    ) -> Situation:
        """What the behaviour is to look at now."""
        ...

    def heed(self, behaviour: Behaviour) -> None:
        """Take note of what the behaviour has made of it."""
        ...

    @property
    def hung(self) -> bool:
        """Whether a part of it never ends, while the rest goes on."""
        ...

    async def close(self) -> None:
        """Once all is written down."""
        ...


class Plain:
    """The senses of a behaviour that goes by the world alone."""

    async def warm_up(self) -> None:
        """Nothing to do."""

    def see(self, state: RobotState) -> None:
        """Nothing to note."""

    def situation(
        self, state: RobotState, world: WorldModel | None, verdict: SafetyState | None
    ) -> Situation:
        """The world and the odometry."""
        return Situation(world, state.pose, must_charge(verdict))

    def heed(self, behaviour: Behaviour) -> None:
        """Nothing to note."""

    @property
    def hung(self) -> bool:
        """It has no parts."""
        return False

    async def close(self) -> None:
        """Nothing to write."""


# name in a deployment file -> "module:class"; the class takes the `decision` part of that file
BEHAVIOURS = {
    "avoid": "gigabrain_zenoh.decision.behaviours.avoid:Avoid",
    "navigate": "gigabrain_zenoh.decision.behaviours.navigate:Navigate",
}
SENSES = {"navigate": "gigabrain_zenoh.decision.navigating:Navigating"}  # of those that need more


OF_ALL = frozenset({"behaviour", "state_dir"})  # settings that hold for every behaviour


def check(name: str) -> None:
    """Raises UnknownName where there is no behaviour called `name`, listing the known ones."""
    if name not in BEHAVIOURS:
        raise unknown("behaviour", name, BEHAVIOURS)


def load(name: str) -> type[Behaviour]:
    """The behaviour called `name`. Raises UnknownName listing the known ones, and ConfigError."""
    check(name)
    return cast("type[Behaviour]", _find(name, BEHAVIOURS[name]))


def unread(config: DecisionConfig) -> tuple[str, ...]:
    """The settings that differ from their defaults and that the behaviour does not read."""
    read = load(config.behaviour).SETTINGS | OF_ALL
    plain = DecisionConfig()
    return tuple(
        name
        for name in DecisionConfig.__struct_fields__
        if name not in read and getattr(config, name) != getattr(plain, name)
    )


def senses(config: DecisionConfig, bus: Bus) -> Senses:
    """What the configured behaviour goes by. Raises ConfigError."""
    if config.behaviour not in SENSES:
        return Plain()
    make = _find(config.behaviour, SENSES[config.behaviour])
    return cast("Callable[[DecisionConfig, Bus], Senses]", make)(config, bus)


def _find(name: str, path: str) -> object:
    module, _, attribute = path.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"behaviour {name} needs {error.name}; pip install 'gigabrain-zenoh[nav]'"
        ) from None
