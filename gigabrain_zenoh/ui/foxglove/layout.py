"""The layout for Lichtblick and Foxglove, with the topic by which its owner steers."""

import os
import re
import secrets
from importlib.resources import files
from pathlib import Path

from gigabrain_zenoh.config.settings import FoxgloveConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.security.identity_files import made_once

SECRET_BYTES = 24
PLACE = "TOPIC_TO_STEER"  # in the package's file, where the topic belongs


def topic_to_steer(config: FoxgloveConfig) -> str:
    """The topic on which a viewer may publish velocities. Raises ConfigError.

    Its secret is for nothing else: layouts are shared, and the page's tokens do more than steer.
    """
    path = Path(config.secret) if config.secret else state_dir() / "foxglove" / "secret"
    secret, _ = made_once(path, secrets.token_urlsafe(SECRET_BYTES).encode())
    if not re.fullmatch(rb"[\w-]{16,200}", secret):
        raise ConfigError(
            f"{path}: expected a secret of 16 letters or more; remove it, and it is made"
        )
    return f"/teleop/{secret.decode()}"


def write_layout(config: FoxgloveConfig, path: Path) -> None:
    """Write the layout into a file that only its owner can read. Raises ConfigError."""
    known = files("gigabrain_zenoh.ui.foxglove").joinpath("layout.json").read_text("utf-8")
    try:
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            os.fchmod(file.fileno(), 0o600)
            file.write(known.replace(PLACE, topic_to_steer(config)))
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None
