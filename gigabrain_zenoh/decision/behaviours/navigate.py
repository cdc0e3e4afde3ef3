"""Drive to goals by the map, as the task queue wants."""

from collections.abc import Mapping
from typing import Any, ClassVar

from gigabrain_zenoh.decision.behaviours import Inputs, NavigationConfig, StepResult


class Navigate:
    """Passes each command of the task queue to the navigator."""

    Config = NavigationConfig
    PARAMS: ClassVar[Mapping[str, str]] = {
        "max_linear_speed": "a number above 0, up to 10 [m/s], or null for the body's limit alone",
    }
    DEMO: ClassVar[Mapping[str, Any]] = {"start": "explore"}

    def __init__(self, config: NavigationConfig) -> None:
        pass

    def configure(self, config: NavigationConfig) -> None:
        """Keep nothing: the navigator has the settings."""

    def step(self, inputs: Inputs) -> StepResult:
        """Carry out the present command."""
        assert inputs.drive
        return inputs.drive(inputs.command)
