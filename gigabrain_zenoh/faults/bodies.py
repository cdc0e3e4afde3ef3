"""The body that is tried where no robot runs."""

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.faults.rig import BODIES, Rig
from gigabrain_zenoh.plugins import find

LOAD_ROBOT = "gigabrain_drivers.catalog:load_robot"


def body_of(rig: Rig) -> str:
    """Its name."""
    return rig.options.body or BODIES["sim"]


def description_of(rig: Rig) -> BodyDescription:
    """What its file says."""
    description: BodyDescription = find(LOAD_ROBOT)(body_of(rig)).description()
    return description
