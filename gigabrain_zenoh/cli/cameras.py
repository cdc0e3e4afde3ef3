"""Cameras of a robot that is about to start: whether it has them, and what they need."""

import importlib.util
import subprocess
import sys

from msgspec import structs

from gigabrain_zenoh.config.settings import RecognizerConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.recognition.node import INSTALL

CHECK_S = 30.0
CHECK = (sys.executable, "-P", "-m", "gigabrain_drivers.sim.graphics")


def with_cameras(deployment: Deployment, host: str) -> Deployment:
    """Return the deployment, without cameras where nothing can be drawn; one line says why.

    Raises ConfigError for cameras that the robot does not have, that need more packages, or that
    cannot follow the simulation's speed.
    """
    here = deployment.hosts.get(host, ())
    placed = any("camera" in names for names in deployment.hosts.values())
    runs = "camera" in here or ("driver" in here and not placed)
    if not deployment.cameras or not runs:
        return deployment
    from gigabrain_drivers.cameras.catalog import RENDERED, cameras_of
    from gigabrain_zenoh.geometry.body_settings import split

    changes = split(deployment.robot)[1]
    cameras = cameras_of(deployment.body, deployment.link, changes)
    read = [one for one in cameras if one.options.source != RENDERED]
    if read and deployment.speed != 1.0:
        raise ConfigError(
            f"camera {read[0].camera.name!r} runs in real time, as its source is "
            f"{read[0].options.source!r}; leave out --speed"
        )
    if len(read) == len(cameras):
        return deployment
    problem = _graphics_problem()
    if not problem:
        return deployment
    print(f"gigabrain: no cameras: {problem}", file=sys.stderr)
    return structs.replace(deployment, cameras=False)


def check_recognizer(deployment: Deployment, host: str) -> None:
    """Raise ConfigError for a net of one's own that `host` is to run, and cannot."""
    here, wanted = deployment.hosts.get(host, ()), deployment.recognizer
    placed = any("recognition" in names for names in deployment.hosts.values())
    runs = "recognition" in here or ("perception" in here and not placed)
    used = deployment.cameras and deployment.recognition and runs
    if not used or wanted == RecognizerConfig():
        return
    if not importlib.util.find_spec("cv2"):
        raise ConfigError(INSTALL)
    from gigabrain_zenoh.vision.nets import load_net

    load_net(wanted)


def _graphics_problem() -> str:
    """Return why nothing can be drawn here, in one line; another process tries it."""
    try:
        tried = subprocess.run(CHECK, capture_output=True, text=True, timeout=CHECK_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigError(f"cannot check for OpenGL: {error}") from None
    if tried.returncode == 0:
        return ""
    lines = (tried.stdout.strip() or tried.stderr.strip() or "OpenGL crashed").splitlines()
    return lines[-1]
