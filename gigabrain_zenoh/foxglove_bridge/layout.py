"""The layout for Lichtblick and Foxglove, with the topic by which its owner steers."""

import os
from importlib.resources import files
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.page.access import token_file, tokens
from gigabrain_zenoh.settings import FoxgloveConfig

PLACE = "TOPIC_TO_STEER"  # in the package's file, where the topic belongs


def topic_to_steer(config: FoxgloveConfig) -> str:
    """The topic on which a viewer may publish velocities. Raises ConfigError."""
    return f"/teleop/{tokens(token_file(config.tokens))[0].operator}"


def write_layout(config: FoxgloveConfig, path: Path) -> None:
    """Write the layout into a file that only its owner can read. Raises ConfigError."""
    known = files("gigabrain_zenoh.foxglove_bridge").joinpath("layout.json").read_text("utf-8")
    try:
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            os.fchmod(file.fileno(), 0o600)
            file.write(known.replace(PLACE, topic_to_steer(config)))
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None
