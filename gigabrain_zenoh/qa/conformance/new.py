"""Writes the package of a new driver, from the texts in `template`."""

import keyword
import re
from importlib import resources
from pathlib import Path
from string import Template

from gigabrain_drivers.driver.catalog import known_drivers, robot_files
from gigabrain_zenoh.errors import ConfigError

_NAME = re.compile(r"[a-z][a-z0-9_]*[a-z0-9]")
FILES = {  # where each text goes
    "pyproject.toml.txt": "pyproject.toml",
    "readme.md.txt": "README.md",
    "init.py.txt": "${name}_driver/__init__.py",
    "driver.py.txt": "${name}_driver/driver.py",
    "robot.yaml.txt": "${name}_driver/robot.yaml",
    "test_driver.py.txt": "tests/test_driver.py",
}


def write(name: str, folder: Path) -> Path:
    """Make `folder`/gigabrain-`name`; returns it. Raises ConfigError, also when it exists."""
    if not _NAME.fullmatch(name) or keyword.iskeyword(name):
        raise ConfigError(
            f"{name!r}: expected lower-case letters, digits and underscores, such as my_robot"
        )
    if name in robot_files() or name in known_drivers():
        raise ConfigError(f"there is a robot or a driver {name!r} already; choose another name")
    path = folder / f"gigabrain-{name.replace('_', '-')}"
    words = {
        "name": name,
        "dashed": name.replace("_", "-"),
        "camel": "".join(part.capitalize() for part in name.split("_")),
    }
    try:
        path.mkdir(parents=True)
        for source, target in FILES.items():
            text = (resources.files(__package__) / "template" / source).read_text(encoding="utf-8")
            file = path / Template(target).substitute(words)
            file.parent.mkdir(exist_ok=True)
            file.write_text(Template(text).substitute(words), encoding="utf-8")
    except FileExistsError:
        raise ConfigError(f"{path} exists; nothing was written") from None
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None
    return path
