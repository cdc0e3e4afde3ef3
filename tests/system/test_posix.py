"""The brain and the tools import on systems without POSIX modules, such as Windows."""

import subprocess
import sys

import pytest

from gigabrain_zenoh.errors import Unsupported
from gigabrain_zenoh.host.posix import _Missing

IMPORT_ALL = """
import builtins, importlib, pkgutil, signal, sys
import gigabrain_drivers, gigabrain_schemas, gigabrain_zenoh

HIDDEN = {"fcntl", "termios", "resource", "tty", "pty", "pwd", "grp"}
real = builtins.__import__

def hide(name, globals=None, *rest):
    if name in HIDDEN and str((globals or {}).get("__name__")).startswith("gigabrain_"):
        raise ImportError(f"no module {name}")
    return real(name, globals, *rest)

for name in ("SIGHUP", "SIGKILL"):
    delattr(signal, name)
builtins.__import__ = hide
failed = []
for package in (gigabrain_schemas, gigabrain_zenoh, gigabrain_drivers):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if found.name.endswith("__main__") or ".faults" in found.name:
            continue  # the fault suite breaks robots on Linux
        if ".qa.train." in found.name:
            continue  # needs the extra `train`
        try:
            importlib.import_module(found.name)
        except (ImportError, AttributeError) as error:
            failed.append(f"{found.name}: {error}")
print("\\n".join(failed))
"""


@pytest.mark.slow
def test_every_module_imports_without_posix_modules() -> None:
    done = subprocess.run(
        (sys.executable, "-W", "ignore", "-c", IMPORT_ALL),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.stdout.strip(), done.stderr) == ("", "")


def test_a_missing_posix_module_is_reported_on_use() -> None:
    with pytest.raises(Unsupported, match=r"^fcntl\.flock needs Linux or macOS$"):
        _Missing("fcntl").flock()
