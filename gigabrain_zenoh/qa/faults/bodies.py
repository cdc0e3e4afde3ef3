"""The body that is tried where no robot runs."""

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.qa.faults.rig import BODIES, Rig


def body_of(rig: Rig) -> str:
    """Its name."""
    return rig.options.body or BODIES["sim"]


def description_of(rig: Rig) -> BodyDescription:
    """What its file says."""
    return load_robot(body_of(rig)).description()
