"""The cameras of a robot on a link, with the source of each, as its file says."""

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from gigabrain_drivers.cameras.base import CameraOptions, options_of, source_class
from gigabrain_drivers.driver.catalog import load_link, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.body import Camera
from gigabrain_zenoh.config.loading import line_in
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import ConfigError

RENDERED = "mujoco"
INSTALL = "cameras need OpenCV; install it with: pip install 'gigabrain-zenoh[eyes]'"


class LinkedCamera(NamedTuple):
    """A camera of a robot, and the options of its source."""

    camera: Camera
    options: CameraOptions
    folder: Path  # of the robot's file


def cameras_of(body: str, link: LinkName, changes: Mapping[str, Any]) -> list[LinkedCamera]:
    """Return the cameras of a robot (a name or a file) on a link.

    Cameras of a simulated world without a source in the file are rendered. Raises ConfigError.
    """
    if not importlib.util.find_spec("cv2"):
        raise ConfigError(INSTALL)
    run = Run(folder=Path(), link=link, cameras=True, changes=dict(changes))
    robot, _, options, folder = load_link(body, run)
    path = robot_path(body)
    if not robot.cameras:
        raise ConfigError(f"{path}: {robot.robot_type} has no cameras; add a part `cameras:`")
    simulated = link != "real" and (robot.sim or {}).get("driver") == "mujoco"
    found = []
    for camera in robot.cameras:
        given = options_of(options.cameras, camera.name)
        wrong = ""
        if given is None and not simulated:
            wrong = f"has no source on the link {link!r}"
        elif given and camera.depth and not source_class(given.source).gives_depth:
            wrong = f"gets no depth from the source {given.source!r}"
        if wrong:
            example = f"`cameras: {{{camera.name}: {{source: opencv, device: /dev/video0}}}}`"
            advice = "name one that gives depth, or write `depth: false`"
            remedy = advice if camera.depth else f"add {example} to it"
            line = line_in(path, (link,)) or 1
            raise ConfigError(f"{path}:{line}: camera {camera.name!r} {wrong}; {remedy}")
        found.append(LinkedCamera(camera, given or CameraOptions(source=RENDERED), folder))
    return found
