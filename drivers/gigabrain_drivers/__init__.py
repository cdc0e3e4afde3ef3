"""Tables of drivers, lidars and cameras. To add one, add a folder, and an entry here.

An entry names both ends of a wire: a body's driver or a lidar's scan source, and the emulator that
answers it. Cameras have no emulator. Other packages offer theirs as entry points in the groups
`gigabrain.drivers`, `gigabrain.lidars`, `gigabrain.cameras` and `gigabrain.emulators`.
"""

from typing import NamedTuple


class Ends(NamedTuple):
    """Both ends of a wire, each as "module:class" and imported only when used."""

    host: str  # a driver.base.Driver; for a lidar, a lidars.base.ScanSource
    emulator: str = ""  # an emulators.base.Device; empty without a wire


# by the name in a robot's file: `driver: NAME` in a link
DRIVERS = {
    "alpha": Ends(
        "gigabrain_drivers.bodies.alpha.driver:AlphaDriver",
        "gigabrain_drivers.bodies.alpha.emulator:Alpha",
    ),
    "feetech": Ends(
        "gigabrain_drivers.bodies.feetech.driver:FeetechDriver",
        "gigabrain_drivers.bodies.feetech.emulator:FeetechArm",
    ),
    "line": Ends(
        "gigabrain_drivers.bodies.line.driver:LineDriver",
        "gigabrain_drivers.bodies.line.emulator:LineBase",
    ),
    "mock": Ends("gigabrain_drivers.bodies.mock.driver:MockBody"),
    "mujoco": Ends("gigabrain_drivers.sim.driver:MujocoDriver"),
    "opencr": Ends(
        "gigabrain_drivers.bodies.turtlebot3.driver:OpenCrDriver",
        "gigabrain_drivers.bodies.turtlebot3.emulator:OpenCr",
    ),
    "piper": Ends(
        "gigabrain_drivers.bodies.piper.driver:PiperDriver",
        "gigabrain_drivers.bodies.piper.emulator:Piper",
    ),
    "ros2": Ends(
        "gigabrain_drivers.bodies.ros2.driver:Ros2Driver",
        "gigabrain_drivers.bodies.ros2.emulator:Ros2Robot",
    ),
}

# by the name in a robot's file: `scan: {driver: NAME}` in a link
LIDARS = {
    "ld06": Ends(
        "gigabrain_drivers.lidars.ld.source:Ld06",
        "gigabrain_drivers.lidars.ld.emulator:LdDevice",
    ),
    "ld19": Ends(
        "gigabrain_drivers.lidars.ld.source:Ld19",
        "gigabrain_drivers.lidars.ld.emulator:LdDevice",
    ),
    "lds01": Ends(
        "gigabrain_drivers.lidars.lds.lds01:Lds01",
        "gigabrain_drivers.lidars.lds.emulator:Lds01Device",
    ),
    "lds02": Ends(
        "gigabrain_drivers.lidars.ld.source:Lds02",
        "gigabrain_drivers.lidars.ld.emulator:Lds02Device",
    ),
    "lds03": Ends(
        "gigabrain_drivers.lidars.lds.lds03:Lds03",
        "gigabrain_drivers.lidars.lds.emulator:Lds03Device",
    ),
    "rplidar": Ends(
        "gigabrain_drivers.lidars.rplidar.source:Rplidar",
        "gigabrain_drivers.lidars.rplidar.emulator:RplidarDevice",
    ),
}


# by the name in a robot's file: `cameras: {front: {source: NAME}}` in a link
CAMERAS = {
    "mujoco": "gigabrain_drivers.cameras.rendered:RenderedCamera",
    "opencv": "gigabrain_drivers.cameras.opencv:OpenCvCamera",
    "replay": "gigabrain_drivers.cameras.replay:ReplayedCamera",
}


def shipped_hosts(table: dict[str, Ends]) -> dict[str, str]:
    """Return the host end of each entry, by name."""
    return {name: ends.host for name, ends in table.items()}


def shipped_emulators() -> dict[str, str]:
    """Return the emulator of each driver and lidar that has one, by name."""
    return {name: ends.emulator for name, ends in (DRIVERS | LIDARS).items() if ends.emulator}
