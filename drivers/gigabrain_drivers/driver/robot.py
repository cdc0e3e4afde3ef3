"""A robot's YAML file: its body, and the links to it."""

from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from gigabrain_drivers.links.serial_link import AUTO, check_port
from gigabrain_schemas.body import BodyDescription, Lidar
from gigabrain_zenoh.config.settings import LinkName

Length = Annotated[float, Meta(ge=0.0, le=10.0)]  # [m], of a part of a body

LINKS: tuple[LinkName, ...] = ("sim", "emulated", "real")


class Demo(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """World and mission of a body's `gigabrain demo`."""

    world: str = "arena"
    mission: str = ""  # a shipped one, or a file beside the robot's file; empty: explore
    cameras: bool = False  # needs --cameras; without them, the demo explores the usual world


class RobotFile(BodyDescription, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole robot.yaml. Each link names its driver; its other fields are the driver's."""

    summary: str  # one line, for `gigabrain robots`
    wheel_base: Length = 0.0  # [m], front to rear, of mecanum and Ackermann bases
    effective_track: Length = 0.0
    # [m], of a skid-steered base: wheel separation of a differential base that turns as much
    arm_model: str = "model.xml"  # MJCF of a body with an arm, beside this file
    demo: Demo = Demo()
    sim: dict[str, Any] | None = None
    emulated: dict[str, Any] | None = None
    real: dict[str, Any] | None = None

    def description(self) -> BodyDescription:
        """Return the fields that the brain uses."""
        names = BodyDescription.__struct_fields__
        return BodyDescription(**{name: getattr(self, name) for name in names})


class ScanOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A lidar on its own line; scan sources add their fields."""

    driver: str  # of gigabrain_drivers.LIDARS, or of an installed package
    port: str = AUTO  # a path, usb:VID:PID[:SERIAL], or auto

    def __post_init__(self) -> None:
        check_port(self.port)


class LinkOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of every link; drivers add their fields."""

    driver: str
    scan: ScanOptions | None = None  # a lidar that the driver reads, see lidars.base.open_lidar
    lidar: Lidar | None = None  # overrides the lidar of the body's file
    cameras: Any = {}  # source of each camera by name, see cameras.base.CameraOptions

    def battery_volts(self) -> tuple[float, float] | None:
        """Return the voltages of an empty and a full battery; None if the driver has none."""
        return None


class Run(Struct, frozen=True, kw_only=True):
    """Settings of one run of a driver."""

    folder: Path  # of the robot's file and its models
    link: LinkName = "sim"
    world: str = "arena"
    seed: int = 0
    speed: float = 1.0  # of real time; other than 1 means lock-step
    seconds: float | None = None  # of simulated time, after which it stands still
    emulator: str = ""  # the folder of the emulator's ports, for link `emulated`
    cameras: bool = False  # False: the robot has no cameras
    checkpoint: str = ""  # path of the simulation's checkpoints; empty: none are written
    changes: dict[str, Any] = {}  # replaced fields of the robot's file
