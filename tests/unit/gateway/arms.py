"""Bodies with arms, and their models as the brain gets them."""

from pathlib import Path

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.body import Body

ARMS = ("so101", "piper", "lekiwi")


def body_of(name: str) -> tuple[Body, str]:
    """Return a body, and the MJCF of its arm."""
    robot, driver = make_driver(name, Run(folder=Path(), world="arena", speed=50.0))
    model = driver.arm_model()
    assert model
    return Body(description=robot.description(), link="sim"), model.mjcf
