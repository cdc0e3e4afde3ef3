"""`gigabrain emulate`: a body that is not there, on real ports."""

from pathlib import Path

from gigabrain_zenoh.cli.checked import checked
from gigabrain_zenoh.config.settings import EmulatorConfig
from gigabrain_zenoh.host.signals import run_async


def emulate(name: str, *, world: str = "arena", seed: int = 0, ports: Path | None = None) -> int:
    """Be a robot's body: its serial ports or its TCP port, with MuJoCo behind them, until Ctrl-C.

    Example: gigabrain emulate mycustombot --world house

    In another terminal: gigabrain driver run mycustombot --link emulated

    Faults are typed in, one line each: `silence`, `bit_errors=0.001`, `scan unplugged`, `off`.

    Parameters
    ----------
    name
        A known robot, or the path of a robot's YAML file.
    world
        Where it stands; see `gigabrain worlds`.
    seed
        For the start pose and the noise of the sensors.
    ports
        The folder in which its ports appear.
    """
    from gigabrain_drivers.driver.catalog import ports_folder
    from gigabrain_drivers.emulators.process import emulate as emulated

    folder = ports or ports_folder(name)
    values = {"body": name, "world": world, "seed": seed, "folder": str(folder.absolute())}
    config = checked(values, EmulatorConfig)
    run_async(emulated(config, _say))
    return 0


def _say(line: str) -> None:
    print(line, flush=True)
