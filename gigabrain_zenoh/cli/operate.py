"""`gigabrain estop`, `release` and `enable`: what a person asks of the gate."""

import getpass
import time
from collections.abc import Awaitable, Callable

from gigabrain_schemas.requests import GateReply
from gigabrain_zenoh.cli.where import HERE, Which
from gigabrain_zenoh.client.estop import BY_HAND
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.client.robot import connect as connect_robot
from gigabrain_zenoh.errors import GigabrainError, NotConfirmed
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.host.signals import run_async


def estop(*, at: Which = HERE, reason: str = "") -> int:
    """Stop the robot at once, and latch it.

    Example: gigabrain estop --reason "somebody is in the way"

    Ends with 3, and NOT CONFIRMED, when no body has said that it stands: then somebody has to
    press the hardware e-stop, or cut the power.

    Parameters
    ----------
    reason
        For the log.
    """
    try:
        return _ask(at, lambda robot: robot.estop(reason), "CONFIRMED by ", wait=False)
    except NotConfirmed:
        raise
    except GigabrainError as error:  # whatever keeps it from being pressed
        raise NotConfirmed(f"NOT CONFIRMED: {error}; {BY_HAND}") from None


def release(*, at: Which = HERE) -> int:
    """Let go of a latched gate. It takes an enable as well to move.

    Example: gigabrain release
    """
    return _ask(at, lambda robot: robot.release())


def enable(*, at: Which = HERE, take: bool = False) -> int:
    """Let the robot's brain drive.

    Example: gigabrain enable

    Parameters
    ----------
    take
        Even when somebody else drives.
    """
    return _ask(at, lambda robot: robot.enable(BRAIN, take=take))


def _ask(
    at: Which,
    ask: Callable[[Robot], Awaitable[GateReply]],
    prefix: str = "",
    *,
    wait: bool = True,
) -> int:
    async def run() -> None:
        source = f"{getpass.getuser()}-cli"
        async with connect_robot(
            at.connect, namespace=at.namespace, keys=at.folder, source=source, wait=wait
        ) as robot:
            began = time.perf_counter()
            reply = await ask(robot)
            took_ms = (time.perf_counter() - began) * 1e3
            print(f"{prefix}{reply.robot_type}: {reply.text} ({took_ms:.0f} ms)")

    run_async(run())
    return 0
