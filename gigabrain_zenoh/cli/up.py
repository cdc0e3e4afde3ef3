"""`gigabrain up`: what a deployment file puts on this host."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gigabrain_zenoh.config.loading import located
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.host.terminal import LINES, Display, writer
from gigabrain_zenoh.runtime.deployment import deployment_path, host_of, load_deployment


def up(
    deployment: str,
    *,
    host: str | None = None,
    keys: Path | None = None,
    level: str = "info",
    keep_stuck: Annotated[bool, Parameter(negative=())] = False,
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
    keep_stuck
        Leave a process alone that makes no progress, for a debugger; else it is started again.
    """
    from gigabrain_zenoh.launch.up import up as run

    path = deployment_path(deployment)
    loaded = load_deployment(path, str(keys.expanduser().absolute()) if keys else "")
    try:
        where = host_of(loaded, host)
        if "decision" in loaded.hosts[where]:
            behaviours.check(loaded.decision, path)
        with Display(writer(sys.stdout), LINES) as display:

            def say(line: str) -> None:
                display.put(f"{line}\n")

            return run_async(run(loaded, where, say, level, keep_stuck=keep_stuck))
    except ConfigError as error:
        raise located(path, error) from None
