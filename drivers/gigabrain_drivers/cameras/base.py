"""The base class of camera sources, and their options in a robot's file."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, cast

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from gigabrain_drivers import CAMERAS
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.plugins import load_plugin

GROUP = "gigabrain.cameras"  # entry points of packages with camera sources
Picture = NDArray[np.uint8]  # (height, width, 3), blue, green, red
Depth = NDArray[np.uint16]  # (height, width) [mm]; 0 is unknown


class CameraOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera in a link of a robot's file; sources add their own fields."""

    source: str  # name in gigabrain_drivers.CAMERAS, or of a package's source
    encoding: Literal["jpeg", "bgr8"] = "jpeg"  # of pictures on the bus
    quality: Annotated[int, Meta(ge=1, le=100)] = 80  # of JPEG compression
    repeat: bool = False  # play a film or a recording again after its end
    repeats: bool = False  # equal pictures are no fault: strong compression of a still scene


class CameraLost(GigabrainError):
    """A camera gives no pictures now. The camera process opens its source again."""


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """One exposure."""

    picture: Picture | None
    depth: Depth | None = None
    tick: int = 0  # of the exposure; 0: the robot's tick when it arrived
    stamp_ns: int = 0  # of the exposure [Unix time]; 0: the time when it arrived


@dataclass(frozen=True)
class CameraSite:
    """A source's folder and random seed."""

    folder: str  # of the robot's file; paths in that file are relative to it
    seed: int = 0


class CameraSource(abc.ABC):
    """Takes the pictures of one camera, in a thread of its own.

    `open` and `read` may block. After CameraLost the process closes the source and opens it again.
    """

    Options: ClassVar[type[CameraOptions]] = CameraOptions  # its fields in a robot's file
    gives_depth: ClassVar[bool] = True  # False: never

    def __init__(self, options: Any, camera: Camera, site: CameraSite) -> None:
        self.options, self.camera, self.site = options, camera, site

    @abc.abstractmethod
    def open(self) -> None:
        """Connect. Raises CameraLost."""

    @abc.abstractmethod
    def read(self) -> Frame:
        """Wait for the next exposure, of the size in the body's file. Raises CameraLost."""

    @abc.abstractmethod
    def close(self) -> None:
        """Free the camera. May be called several times, in any state."""


def source_class(name: str) -> type[CameraSource]:
    """Return the source called `name`, shipped or from an installed package.

    Raises UnknownName listing the known ones, and ConfigError where it cannot be imported.
    """
    return cast("type[CameraSource]", load_plugin("camera source", name, CAMERAS, GROUP))


def camera_options(robot: BodyDescription, part: Any) -> Any:
    """Return the type of a link's `cameras`: one field for each camera of the body.

    Raises UnknownName for an unknown source, and ConfigError for one that cannot be imported.
    """
    entries = part if isinstance(part, Mapping) else {}
    fields = []
    for camera in robot.cameras:
        entry = entries.get(camera.name)
        source = entry.get("source") if isinstance(entry, Mapping) else None
        kind = source_class(source).Options if isinstance(source, str) else CameraOptions
        fields.append((camera.name, kind | None, None))
    return msgspec.defstruct(
        "LinkCameras",
        fields,
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
        omit_defaults=True,
    )


def options_of(cameras: Any, name: str) -> CameraOptions | None:
    """Return the options of one camera in `LinkOptions.cameras`; None where it has none."""
    return None if isinstance(cameras, Mapping) else getattr(cameras, name, None)
