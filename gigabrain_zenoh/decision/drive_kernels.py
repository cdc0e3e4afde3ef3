"""The kernels of planning and driving: those that every body needs, and those of some bodies."""

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.host.threads import InTime
from gigabrain_zenoh.kernels.precompile import Kernels

# each calls its kernels once
DRIVE_KERNELS = "gigabrain_zenoh.decision.navigator:warm_up"
CAR_KERNELS = "gigabrain_zenoh.navigation.car_planner:warm_up"
TRAFFIC_KERNELS = "gigabrain_zenoh.navigation.local_planner:warm_up_traffic"


class DriveKernels:
    """Loads the kernels that all bodies need first, and what else a body needs once it is known."""

    def __init__(self, in_time: InTime) -> None:
        self._for_all = Kernels(DRIVE_KERNELS, in_time)
        self._for_some = {one: Kernels(one, in_time) for one in (CAR_KERNELS, TRAFFIC_KERNELS)}

    async def load(self, *, wait: bool) -> bool:
        """Load them, with `wait` those of every body; return whether that is done.

        Otherwise they compile meanwhile. Raises ConfigError if a package for them is not installed.
        """
        await self._for_all.load(wait=wait)
        if wait:
            for kernels in self._for_some.values():
                await kernels.load(wait=True)
        return not self._for_all.beside

    async def finish(self) -> None:
        """Return once those that all bodies need are loaded. Raises ConfigError as above."""
        await self._for_all.finish()

    def loaded(self, body: BodyDescription | None) -> bool:
        """Whether a body can drive by them from the present scan on. Raises ConfigError."""
        if not self._for_all.loaded:
            return False
        some = [self._for_some[one] for one in _for_some(body)] if body else []
        for kernels in some:
            kernels.begin()
        return all(kernels.loaded for kernels in some)

    async def close(self) -> None:
        """Stop compiling."""
        for kernels in (self._for_all, *self._for_some.values()):
            await kernels.close()


def _for_some(body: BodyDescription) -> tuple[str, ...]:
    from gigabrain_zenoh.navigation.dynamic_obstacles import QUICK_BODY_SPEED  # imports numba

    car = (CAR_KERNELS,) if body.drive_type == "ackermann" else ()
    return (*car, TRAFFIC_KERNELS) if body.max_linear_speed > QUICK_BODY_SPEED else car
