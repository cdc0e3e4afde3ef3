"""A robot's YAML file: what the body is, and by which links it can be reached."""

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
    mission: str = ""  # shipped one, or a file beside the robot's file; empty: it explores
    cameras: bool = False  # only with --cameras; without, it explores the usual world


class RobotFile(BodyDescription, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole robot.yaml. Each link names its driver; the rest of it is the driver's own."""

    summary: str  # one line, for `gigabrain robots`
    wheel_base: Length = 0.0  # [m], front to rear, of mecanum and Ackermann bases
    effective_track: Length = 0.0
    # [m], of a skid-steered base: the separation of rolling wheels that would turn it as much
    arm_model: str = "model.xml"  # MJCF of a body with an arm, beside this file
    demo: Demo = Demo()
    sim: dict[str, Any] | None = None
    emulated: dict[str, Any] | None = None
    real: dict[str, Any] | None = None

    def description(self) -> BodyDescription:
        """Return the part that the brain uses."""
        names = BodyDescription.__struct_fields__
        return BodyDescription(**{name: getattr(self, name) for name in names})


class ScanOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A lidar on a line of its own; scan sources add their own fields."""

    driver: str  # one of gigabrain_drivers.LIDARS, or of a package's
    port: str = AUTO  # a path, usb:VID:PID[:SERIAL], or auto

    def __post_init__(self) -> None:
        check_port(self.port)


class LinkOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of every link; drivers add their own fields."""

    driver: str
    scan: ScanOptions | None = None  # a lidar that the driver carries, see lidars.base.open_lidar
    lidar: Lidar | None = None  # overrides the lidar of the body's file
    cameras: Any = {}  # the source of each camera, by its name; see cameras.base.CameraOptions

    def battery_volts(self) -> tuple[float, float] | None:
        """Return the voltages that the driver takes for empty and full, where it has any."""
        return None


class Run(Struct, frozen=True, kw_only=True):
    """Settings of one run of a driver."""

    folder: Path  # where the robot's file and its models are
    link: LinkName = "sim"
    world: str = "arena"
    seed: int = 0
    speed: float = 1.0  # of real time; other than 1 means lock-step
    seconds: float | None = None  # of simulated time, then it holds still
    emulator: str = ""  # the folder of the emulator's ports, where the link is `emulated`
    cameras: bool = False  # whether its cameras are used; otherwise the robot has none
    checkpoint: str = ""  # path of a simulation's checkpoints in this run; empty: it keeps none
    changes: dict[str, Any] = {}  # fields of the robot's file that are other in this run
