"""Loads the compiled kernels of planning and driving: for all bodies, for cars, and for arms."""

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.host.threads import InTime
from gigabrain_zenoh.kernels.precompile import Kernels

# functions that call each of their kernels once
DRIVE_KERNELS = "gigabrain_zenoh.decision.navigator:warm_up"
CAR_KERNELS = "gigabrain_zenoh.navigation.car_planner:warm_up"
ARM_KERNELS = "gigabrain_zenoh.manipulation.descent:warm_up"


class DriveKernels:
    """Loads the kernels for all bodies, and those for cars and arms once the body needs them."""

    def __init__(self, in_time: InTime) -> None:
        self._for_all = Kernels(DRIVE_KERNELS, in_time)
        self._for_cars = Kernels(CAR_KERNELS, in_time)
        self._for_arms = Kernels(ARM_KERNELS, in_time)

    async def load(self, *, wait: bool) -> bool:
        """Load the kernels for all bodies, and return whether they are loaded.

        Missing ones are compiled in the background; with `wait`, before this returns. Raises
        ConfigError if a package for them is not installed.
        """
        await self._for_all.load(wait=wait)
        if wait:
            await self._for_cars.load(wait=True)
        return not self._for_all.beside

    async def finish(self) -> None:
        """Wait until the kernels for all bodies are loaded. Raises ConfigError like `load`."""
        await self._for_all.finish()

    def loaded(self, body: BodyDescription | None) -> bool:
        """Return whether all kernels for `body` are loaded; start to load missing ones.

        Raises ConfigError.
        """
        if not self._for_all.loaded or body is None or body.drive_type != "ackermann":
            return self._for_all.loaded
        self._for_cars.begin()
        return self._for_cars.loaded

    def arm_loaded(self) -> bool:
        """Return whether the kernels for arms are loaded; start to load missing ones.

        Raises ConfigError.
        """
        self._for_arms.begin()
        return self._for_arms.loaded

    async def close(self) -> None:
        """Stop compiling."""
        await self._for_all.close()
        await self._for_cars.close()
        await self._for_arms.close()
