"""Faults of data: nonsense, tearing, blindness, obstacles, batteries, recordings."""

from gigabrain_zenoh.qa.faults.blind import blind_lidar
from gigabrain_zenoh.qa.faults.charge import battery_and_temperature
from gigabrain_zenoh.qa.faults.fault import Measured, Skipped
from gigabrain_zenoh.qa.faults.nonsense import hostile_values
from gigabrain_zenoh.qa.faults.obstacles import obstacle_at_stopping_distance, thin_obstacles
from gigabrain_zenoh.qa.faults.reversals import full_reversals
from gigabrain_zenoh.qa.faults.rig import Rig

__all__ = [
    "battery_and_temperature",
    "blind_lidar",
    "full_reversals",
    "hostile_values",
    "obstacle_at_stopping_distance",
    "recorder_killed",
    "thin_obstacles",
]


async def recorder_killed(rig: Rig) -> Measured:
    """Where a recorder is installed."""
    try:
        from gigabrain_zenoh.qa.faults import taping
    except ModuleNotFoundError as error:
        raise Skipped(f"needs gigabrain-zenoh[record]: {error.name} is missing") from None
    return await taping.recorder_killed(rig)
