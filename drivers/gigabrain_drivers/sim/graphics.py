"""OpenGL without a window: EGL, else OSMesa. Run with `python -m` to check for it."""

import importlib
import logging
import os
import sys
from typing import Any

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import this_process

BACKENDS = ("cgl",) if sys.platform == "darwin" else ("egl", "osmesa")
MISSING = (
    "on Debian: apt-get install libegl1 libgl1-mesa-dri (or libosmesa6); "
    "and pip install 'gigabrain-zenoh[eyes]'"
)


def open_graphics(width: int, height: int) -> Any:
    """Return an OpenGL context of this size [px], current in this thread. Call its `free`.

    MUJOCO_GL may choose `egl` or `osmesa`. Raises ConfigError naming the missing packages.
    """
    logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)
    chosen = this_process.chosen_graphics().lower()
    problems = []
    for name in (chosen,) if chosen in BACKENDS else BACKENDS:
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
            context.make_current()
            return context
        except Exception as error:  # noqa: BLE001 - PyOpenGL raises anything without its library
            problems.append(f"{name}: {' '.join(str(error).split())[:80]}")
            _forget()
    raise ConfigError(f"cannot draw without OpenGL ({'; '.join(problems)}); {MISSING}")


def _forget() -> None:
    """Unload PyOpenGL: it chooses its platform only on import."""
    os.environ.pop("PYOPENGL_PLATFORM", None)
    for module in list(sys.modules):
        if module.split(".")[0] == "OpenGL" or module in ("mujoco.egl", "mujoco.osmesa"):
            del sys.modules[module]


def main() -> None:
    """Exit with code 2 and one line if nothing can be drawn."""
    try:
        open_graphics(64, 64).free()
    except ConfigError as error:
        print(error)
        sys.exit(ConfigError.exit_code)


if __name__ == "__main__":
    main()
