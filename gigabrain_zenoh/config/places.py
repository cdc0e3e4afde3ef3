"""Where in a file a name stands that turned out wrong only when it was used."""

import re
from collections.abc import Iterator
from pathlib import Path

from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.config import yaml_text as config_yaml
from gigabrain_zenoh.errors import ConfigError


def located(path: Path, error: ConfigError) -> ConfigError:
    """What a process says of a name that it was given, with that name's line in the file."""
    if named := re.match(r"no \w+ ('.*?');", str(error)):
        for node in _scalars(config_yaml.read(config.read(path))):
            if repr(node.value) == named[1]:
                return type(error)(f"{path}:{node.line}: {error}")
    return error


def _scalars(node: config_yaml.Node) -> Iterator[config_yaml.Node]:
    children = [entry.node for entry in node.entries or ()] + list(node.items or ())
    if not children:
        yield node
    for child in children:
        yield from _scalars(child)
