"""The base of every camera's source, and how a link of a robot's file names the sources."""

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

GROUP = "gigabrain.cameras"  # of entry points
Picture = NDArray[np.uint8]  # (height, width, 3), blue, green, red
Depth = NDArray[np.uint16]  # (height, width) [mm], 0 is unknown


class CameraOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera in a link of a robot's file; sources add their own fields."""

    source: str  # one of gigabrain_drivers.CAMERAS, or of a package's
    encoding: Literal["jpeg", "bgr8"] = "jpeg"  # of its pictures on the bus
    quality: Annotated[int, Meta(ge=1, le=100)] = 80  # of a JPEG
    repeat: bool = False  # whether a film or a recording begins again at its end
    repeats: bool = False  # a still scene may give the same picture twice, as in strong compression


class CameraLost(GigabrainError):
    """A camera gives no pictures now; its source is opened again."""


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """One exposure."""

    picture: Picture | None
    depth: Depth | None = None
    tick: int = 0  # of the exposure, by the robot's clock; 0: the newest one when it came
    stamp_ns: int = 0  # of the exposure [Unix time]; 0: when it came


@dataclass(frozen=True)
class CameraSite:
    """The folder and the seed that a source works with."""

    folder: str  # of the robot's file, to which paths in it are relative
    seed: int = 0


class CameraSource(abc.ABC):
    """Takes the pictures of one camera, in a thread of its own.

    `open` and `read` may wait; after CameraLost, the source is closed, and soon opened again.
    """

    Options: ClassVar[type[CameraOptions]] = CameraOptions  # its part of a robot's file
    gives_depth: ClassVar[bool] = True  # or may do so

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
        """Let go of the camera; any number of times, in any state."""


def source_class(name: str) -> type[CameraSource]:
    """Return the source called `name`: one of ours, or one that a package offers.

    Raises UnknownName listing the known ones, and ConfigError where it cannot be imported.
    """
    return cast("type[CameraSource]", load_plugin("camera source", name, CAMERAS, GROUP))


def camera_options(robot: BodyDescription, part: Any) -> Any:
    """Return the type of the part `cameras` of a link: a field for each camera of the body.

    Raises UnknownName and ConfigError for a source that is not there.
    """
    named = part if isinstance(part, Mapping) else {}
    fields = []
    for camera in robot.cameras:
        one = named.get(camera.name)
        source = one.get("source") if isinstance(one, Mapping) else None
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
