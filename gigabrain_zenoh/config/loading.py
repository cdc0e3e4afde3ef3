"""Configuration: a YAML file becomes a frozen msgspec Struct, or one line says why not."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import msgspec

from gigabrain_zenoh.config import faults as config_faults
from gigabrain_zenoh.config import yaml_text as config_yaml
from gigabrain_zenoh.config.renames import renamed_fields
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded_file import read_bounded

T = TypeVar("T")

MOST_BYTES = 256 * 1024  # a hundred times what a large robot's file holds


def load(path: Path, type: type[T]) -> T:
    """The `type` that a YAML file describes.

    Raises ConfigError, whose one line reads `FILE:LINE: what is wrong; what was expected`.
    """
    return loads(read(path), type, str(path))


def read(path: Path) -> str:
    """The text of a YAML file. Raises ConfigError."""
    try:
        data = read_bounded(path, MOST_BYTES)
        return data.decode()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file{_nearest(path)}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        byte = data[error.start]
        raise ConfigError(f"{path}:{line}: byte 0x{byte:02x}; expected UTF-8 text") from None


def loads(text: str, type: type[T], source: str, at: Sequence[str] = ()) -> T:
    """Return the `type` that a YAML text describes; `source` is the file name in errors.

    With `at`, such as ("decision", "settings"), only that section is read; missing ones are empty.
    """
    try:
        root = renamed_fields(config_yaml.read(text), source)
        for name in at:
            found = (entry.node for entry in root.entries or () if entry.key == name)
            root = next(found, config_yaml.Node(root.line, {}, entries=()))
        return msgspec.convert(root.value, type)
    except config_yaml.YamlFault as fault:
        raise _error(source, fault.line, str(fault)) from None
    except msgspec.ValidationError as error:
        where = config_faults.find(root, type) or config_faults.Fault(root.line, str(error))
        raise _error(source, where.line, where.text) from None


def _error(source: str, line: int, text: str) -> ConfigError:
    return ConfigError(" ".join(f"{source}:{line}: {text}".split()))


def _nearest(path: Path) -> str:
    names = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
    close = difflib.get_close_matches(path.name, names, 1)
    return f"; did you mean '{path.with_name(close[0])}'?" if close else "; expected a YAML file"
