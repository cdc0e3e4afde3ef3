"""Checks the cameras of a robot before its start: graphics, packages and recognition."""

import importlib.util
import subprocess
import sys

from msgspec import structs

from gigabrain_zenoh.config.settings import RecognizerConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.recognition.node import INSTALL

CHECK_TIMEOUT_S = 30.0
CHECK_COMMAND = (sys.executable, "-P", "-m", "gigabrain_drivers.sim.graphics")


def with_cameras(deployment: Deployment, host: str) -> Deployment:
    """Return the deployment, without cameras if this host cannot render; then print the reason.

    Raises ConfigError for cameras that the robot does not have, that need more packages, or that
    run only in real time.
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
    physical = [camera for camera in cameras if camera.options.source != RENDERED]
    if physical and deployment.speed != 1.0:
        raise ConfigError(
            f"camera {physical[0].camera.name!r} runs in real time, as its source is "
            f"{physical[0].options.source!r}; leave out --speed"
        )
    if len(physical) == len(cameras):
        return deployment
    problem = _graphics_problem()
    if not problem:
        return deployment
    print(f"gigabrain: no cameras: {problem}", file=sys.stderr)
    return structs.replace(deployment, cameras=False)


def check_recognizer(deployment: Deployment, host: str) -> None:
    """Raise ConfigError for a recognition net of the user's own that `host` cannot run."""
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
    """Return the reason in one line why this host cannot render; tried in a child process."""
    try:
        tried = subprocess.run(
            CHECK_COMMAND, capture_output=True, text=True, timeout=CHECK_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigError(f"cannot check for OpenGL: {error}") from None
    if tried.returncode == 0:
        return ""
    lines = (tried.stdout.strip() or tried.stderr.strip() or "OpenGL crashed").splitlines()
    return lines[-1]
