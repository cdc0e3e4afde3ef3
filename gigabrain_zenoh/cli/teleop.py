"""`gigabrain teleop`: drive by keys or by a gamepad."""

from gigabrain_zenoh.cli.where import HERE, Which
from gigabrain_zenoh.host.signals import run_async


def teleop(
    *,
    at: Which = HERE,
    take: bool = False,
) -> int:
    """Drive the robot by keys or by a gamepad.

    Example: gigabrain teleop --take

    Speeds stay within what safety allows. Letting go of a key stops the robot; the space bar is the
    e-stop. At the end the body goes back to the robot's brain.

    Parameters
    ----------
    take
        Even when somebody else drives, the robot's own brain included.
    """
    import getpass
    import sys

    from gigabrain_zenoh.client.robot import connect as connect_robot
    from gigabrain_zenoh.errors import ConfigError
    from gigabrain_zenoh.ui.teleop_station import Gamepad, TeleopStation

    async def run() -> None:
        pad = Gamepad()
        try:
            if not sys.stdin.isatty() and pad.pad is None:
                raise ConfigError("teleop needs a terminal to type in, or a gamepad")
            source = f"{getpass.getuser()}-teleop"
            async with connect_robot(
                at.connect, namespace=at.namespace, keys=at.folder, source=source
            ) as robot:
                await TeleopStation(robot, pad).drive(take)
        finally:
            pad.close()

    run_async(run())
    return 0
