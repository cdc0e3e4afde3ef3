"""`gigabrain up`: what a deployment file puts on this host."""

import asyncio
import errno
from collections.abc import Callable
from pathlib import Path

from gigabrain_zenoh.config_places import located
from gigabrain_zenoh.deployment import deployment_path, host_of, load_deployment
from gigabrain_zenoh.errors import ConfigError


def up(
    deployment: str, *, host: str | None = None, keys: Path | None = None, level: str = "info"
) -> int:
    """Start what a deployment file puts on this host, and keep it running until Ctrl-C.

    Example: gigabrain up deploy/demo.yaml

    Parameters
    ----------
    deployment
        A deployment file.
    host
        Which of the file's hosts this is; needed where it has several.
    keys
        The folder of this host's identity, in place of the one in the file.
    level
        The least level of what is logged: debug, info, warning or error.
    """
    from gigabrain_zenoh.launch import up as run

    path = deployment_path(deployment)
    loaded = load_deployment(path, str(keys.expanduser().absolute()) if keys else "")
    try:
        return asyncio.run(run(loaded, host_of(loaded, host), _printer(), level))
    except ConfigError as error:
        raise located(path, error) from None


def _printer() -> Callable[[str], None]:
    """Prints lines for as long as somebody reads them: a robot goes on without its pager."""
    read = True

    def say(line: str) -> None:
        nonlocal read
        try:
            if read:
                print(line, flush=True)
        except OSError as error:  # the pager has ended, or the terminal; a disk may have room again
            read = error.errno == errno.ENOSPC

    return say
