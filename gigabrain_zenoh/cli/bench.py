"""`gigabrain bench chain`, `stack` and `estop`: what this machine makes of it."""

import sys
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Console, RenderableType

from gigabrain_zenoh.cli.checked import above_zero
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import files
from gigabrain_zenoh.host.signals import run_async

FASTEST_HZ = 50.0  # one scan per tick of the robot's clock


def chain(
    *,
    seconds: float = 10.0,
    rounds: int = 3,
    rates: Annotated[tuple[float, ...], Parameter(consume_multiple=True)] = (10.0, 50.0),
    json: Path | None = None,
) -> int:
    """Time the way from a scan to its command, in turns with a bare Zenoh relay.

    Example: gigabrain bench chain --seconds 10 --rounds 3 --rates 10 50

    Parameters
    ----------
    seconds
        Length of each run [s].
    rounds
        How often the chain and the relay take turns.
    rates
        How many scans a second [Hz].
    json
        Write all figures into this file.
    """
    from gigabrain_zenoh.qa.bench.chain import chain_page, measure_chain

    files.check_result_path(json)
    above_zero("seconds", seconds)
    above_zero("rounds", rounds)
    for rate in rates:
        if not 0 < rate <= FASTEST_HZ:
            raise ConfigError(f"--rates: expected above 0, at most {FASTEST_HZ:g}, got {rate:g}")

    result = run_async(measure_chain(seconds, rounds, rates, _progress))
    _finish(chain_page(result), result, json)
    return 0


def stack(
    *,
    seconds: float = 20.0,
    body: str = "turtlebot3_waffle",
    world: str = "arena",
    goal: bool = False,
    json: Path | None = None,
) -> int:
    """Measure what a whole robot needs: CPU, memory, and time to start.

    Example: gigabrain bench stack --seconds 20 --world house --goal

    Parameters
    ----------
    seconds
        How long to measure [s].
    body
        Which robot; see `gigabrain robots`.
    world
        Where it drives; see `gigabrain worlds`.
    goal
        Start it once more, with a map, and time how soon it may be sent to a place.
    json
        Write all figures into this file.
    """
    from gigabrain_zenoh.qa.bench.stack import measure_stack, stack_page

    files.check_result_path(json)
    above_zero("seconds", seconds)
    result = run_async(measure_stack(body, world, seconds, _progress, goal=goal))
    _finish(stack_page(result), result, json)
    return 0


def estop(
    *,
    body: str = "turtlebot3_waffle",
    driving: int = 10,
    latched: int = 200,
    json: Path | None = None,
) -> int:
    """Time the e-stop, from the press to the gate's zero, idle and while the network is flooded.

    Example: gigabrain bench estop --driving 10 --latched 200

    Parameters
    ----------
    body
        Which robot; see `gigabrain robots`.
    driving
        How often to press while it drives.
    latched
        How often to press after that, while it is latched.
    json
        Write all figures into this file.
    """
    from gigabrain_zenoh.qa.bench.estop import estop_page, measure_estop

    files.check_result_path(json)
    above_zero("driving", driving)
    above_zero("latched", latched)
    result = run_async(measure_estop(body, driving, latched, _progress))
    _finish(estop_page(result), result, json)
    return 0


def _progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _finish(page: RenderableType, result: msgspec.Struct, json: Path | None) -> None:
    Console().print(page)
    files.write_result(result, json)
