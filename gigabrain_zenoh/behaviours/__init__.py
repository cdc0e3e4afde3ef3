"""What decision can do. Adding a behaviour means a module and a line in BEHAVIOURS."""

import importlib
from typing import Protocol, cast

import msgspec

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_zenoh.errors import unknown
from gigabrain_zenoh.settings import DecisionConfig


class Situation(msgspec.Struct, frozen=True):
    """What a behaviour may look at."""

    world: WorldModel | None  # None while perception is silent
    pose: Pose  # odometry of the same tick
    must_charge: bool = False  # safety says that the battery is nearly empty


class Behaviour(Protocol):
    """Turns one situation after the other into intents. It keeps its own memory, and no clock."""

    def __init__(self, config: DecisionConfig) -> None: ...

    def step(self, situation: Situation) -> Intent:
        """What to do now."""
        ...


# name in a deployment file -> "module:class"; the class takes the `decision` part of that file
BEHAVIOURS = {
    "avoid": "gigabrain_zenoh.behaviours.avoid:Avoid",
}


def load(name: str) -> type[Behaviour]:
    """The behaviour called `name`. Raises UnknownName listing the known ones."""
    if name not in BEHAVIOURS:
        raise unknown("behaviour", name, BEHAVIOURS)
    module, _, attribute = BEHAVIOURS[name].partition(":")
    return cast("type[Behaviour]", getattr(importlib.import_module(module), attribute))
