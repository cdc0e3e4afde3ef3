"""`gigabrain warm`: compile beforehand what takes a minute at the first start."""

import time

STEPS = ("mapping", "planning and driving")


def warm() -> None:
    """Compile mapping and navigation, so that the first start is as quick as every other.

    Example: gigabrain warm

    What was compiled is kept in the user's cache folder, or in NUMBA_CACHE_DIR where that is set.
    After an update it is done again, at the latest at the first start, while nothing drives.
    """
    from gigabrain_zenoh.compiling import needs

    for name in STEPS:
        print(f"{name} … ", end="", flush=True)
        began_s = time.monotonic()
        try:
            _compile(name)
        except ModuleNotFoundError as error:
            print()
            raise needs(error) from None
        print(f"{time.monotonic() - began_s:.1f} s")


def _compile(name: str) -> None:
    from gigabrain_zenoh.compiling import DRIVING, FINDING, MAPPING, compile_all

    for warm_up in (MAPPING, FINDING) if name == "mapping" else (DRIVING,):
        compile_all(warm_up)
