"""`gigabrain warm`: compile beforehand what takes a minute at the first start."""

import asyncio
import time

from gigabrain_zenoh.host.signals import run_async


def warm() -> None:
    """Compile mapping and navigation, so that the first start is as quick as every other.

    Example: gigabrain warm

    What was compiled is kept in the user's cache folder, or in NUMBA_CACHE_DIR where that is set.
    After an update it is done again, at the latest at the first start, while nothing drives.
    """
    run_async(_all())


async def _all() -> None:
    """Both at a time: they share no kernel."""
    from gigabrain_zenoh.decision.goal_server import DRIVE_KERNELS
    from gigabrain_zenoh.perception.node import LOCALIZE_KERNELS, MAP_KERNELS

    print("compiling, which takes up to a minute", flush=True)
    await asyncio.gather(
        _compile("mapping", MAP_KERNELS, LOCALIZE_KERNELS),
        _compile("planning and driving", DRIVE_KERNELS),
    )


async def _compile(name: str, *warm_ups: str) -> None:
    from gigabrain_zenoh.kernels.precompile import compile_all, compile_in_child, missing_package

    began_s = time.monotonic()
    for warm_up in warm_ups:
        if await compile_in_child(warm_up):
            try:
                compile_all(warm_up)  # says why it cannot be done
            except ModuleNotFoundError as error:
                raise missing_package(error) from None
    print(f"{name}: {time.monotonic() - began_s:.1f} s", flush=True)
