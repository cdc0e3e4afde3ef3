"""`gigabrain page`: the robot in a browser."""

from pathlib import Path


def page(
    *,
    port: int = 8080,
    listen: str = "127.0.0.1",
    name: tuple[str, ...] = (),
    certificate: Path | None = None,
    certificate_key: Path | None = None,
    login: bool = False,
    connect: str | None = None,
    namespace: str = "",
    keys: Path | None = None,
) -> int:
    """Serve the operator page: see the robot in a browser, and steer it.

    Example: gigabrain page --port 8080

    Beyond this machine it wants a certificate, and whoever opens it a token: one to drive, one to
    look. They are printed when they are made, and kept in a file of mode 0600.

    Parameters
    ----------
    port
        Where it listens.
    listen
        The address of this machine to listen on.
    name
        A name by which browsers ask for it, beside that address.
    certificate
        A PEM file, for TLS.
    certificate_key
        Its key.
    login
        Want a token on this machine as well.
    connect
        The router's Zenoh endpoint; without it, the only robot that runs on this machine.
    namespace
        The robot's own part of the key space.
    keys
        The folder of your identity, for a router that wants one.
    """
    import msgspec

    from gigabrain_zenoh.cli.checked import checked
    from gigabrain_zenoh.errors import ConfigError
    from gigabrain_zenoh.page.access import check
    from gigabrain_zenoh.page.node import INSTALL, installed
    from gigabrain_zenoh.process import run
    from gigabrain_zenoh.process_config import ProcessConfig
    from gigabrain_zenoh.running import find_endpoint
    from gigabrain_zenoh.settings import PageConfig

    if not installed():
        raise ConfigError(INSTALL)
    values = {
        "port": port,
        "listen": listen,
        "names": name,
        "certificate": str(certificate or ""),
        "certificate_key": str(certificate_key or ""),
        "login": login,
        "tell_tokens": True,
    }
    config = checked(values, PageConfig)
    check(config)
    endpoint = find_endpoint(connect, namespace, str(keys) if keys else "")
    return run(ProcessConfig(name="page", endpoint=endpoint, settings=msgspec.to_builtins(config)))
