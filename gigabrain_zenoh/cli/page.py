"""`gigabrain page`: the robot in a browser."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from gigabrain_zenoh.cli.where import HERE, Which

if TYPE_CHECKING:
    from gigabrain_zenoh.config.settings import PageConfig


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Served:
    """Where the page is, and for whom."""

    port: int = 8080
    "Where it listens."
    listen: str = "127.0.0.1"
    "The address of this machine to listen on."
    name: tuple[str, ...] = ()
    "A name by which browsers ask for it, beside that address."
    certificate: Path | None = None
    "A PEM file, for TLS."
    certificate_key: Path | None = None
    "Its key."
    login: bool = False
    "Want a token on this machine as well."

    def config(self) -> "PageConfig":
        """The settings of its process. Raises ConfigError."""
        from gigabrain_zenoh.cli.checked import checked
        from gigabrain_zenoh.config.settings import PageConfig

        values = {
            "port": self.port,
            "listen": self.listen,
            "names": self.name,
            "certificate": str(self.certificate or ""),
            "certificate_key": str(self.certificate_key or ""),
            "login": self.login,
            "tell_tokens": True,
        }
        return checked(values, PageConfig)


LOCALLY = Served()


def page(*, served: Served = LOCALLY, at: Which = HERE) -> int:
    """Serve the operator page: see the robot in a browser, and steer it.

    Example: gigabrain page --port 8080

    Beyond this machine it wants a certificate, and whoever opens it a token: one to drive, one to
    look. They are printed when they are made, and kept in a file of mode 0600.
    """
    import msgspec

    from gigabrain_zenoh.config.settings import ProcessConfig
    from gigabrain_zenoh.errors import ConfigError
    from gigabrain_zenoh.launch.processes import run_process
    from gigabrain_zenoh.runtime.running import find_endpoint
    from gigabrain_zenoh.ui.page.access import check
    from gigabrain_zenoh.ui.page.node import INSTALL, installed

    if not installed():
        raise ConfigError(INSTALL)
    config = served.config()
    check(config)
    endpoint = find_endpoint(at.connect, at.namespace, at.folder)
    return run_process(
        ProcessConfig(name="page", endpoint=endpoint, settings=msgspec.to_builtins(config))
    )
