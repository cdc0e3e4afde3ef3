"""Loads the kernels of planning and moving: those of all bodies, of cars, and of arms."""

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.host.threads import InTime
from gigabrain_zenoh.kernels.precompile import Kernels

# each calls its kernels once
DRIVE_KERNELS = "gigabrain_zenoh.decision.navigator:warm_up"
CAR_KERNELS = "gigabrain_zenoh.navigation.car_planner:warm_up"
ARM_KERNELS = "gigabrain_zenoh.manipulation.descent:warm_up"


class DriveKernels:
    """Loads the kernels that all bodies need, and those of a car or an arm once there is one."""

    def __init__(self, in_time: InTime) -> None:
        self._for_all = Kernels(DRIVE_KERNELS, in_time)
        self._for_cars = Kernels(CAR_KERNELS, in_time)
        self._for_arms = Kernels(ARM_KERNELS, in_time)

    async def load(self, *, wait: bool) -> bool:
        """Load those that all bodies need, and return whether that is done.

        Those that are still to be compiled compile meanwhile; with `wait`, all are compiled first.
        Raises ConfigError if a package for them is not installed.
        """
        await self._for_all.load(wait=wait)
        if wait:
            await self._for_cars.load(wait=True)
        return not self._for_all.beside

    async def finish(self) -> None:
        """Return once those that all bodies need are loaded. Raises ConfigError as above."""
        await self._for_all.finish()

    def loaded(self, body: BodyDescription | None) -> bool:
        """Return whether all that `body` needs can be used from this scan on. Raises ConfigError.

        Begins to load what is missing.
        """
        if not self._for_all.loaded or body is None or body.drive_type != "ackermann":
            return self._for_all.loaded
        self._for_cars.begin()
        return self._for_cars.loaded

    def arm_loaded(self) -> bool:
        """Return whether what an arm needs can be used from this step on. Raises ConfigError."""
        self._for_arms.begin()
        return self._for_arms.loaded

    async def close(self) -> None:
        """Stop compiling."""
        await self._for_all.close()
        await self._for_cars.close()
        await self._for_arms.close()
