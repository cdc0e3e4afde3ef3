"""`gigabrain teleop`, `page`, `view` and `foxglove`: views of a robot for people."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter

from gigabrain_zenoh.cli.options import LOCAL, RobotAddress, Take, checked, print_line
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.host.this_process import user_name

if TYPE_CHECKING:
    from gigabrain_zenoh.config.settings import PageConfig


def teleop(
    *,
    at: RobotAddress = LOCAL,
    take: Take = False,
    leader: str | None = None,
    leader_calibration: str = "",
) -> None:
    """Drive the robot by keyboard or gamepad, or move its arm with a second one.

    Example: gigabrain teleop --take

    Speeds stay within the limits of safety. Releasing a key stops the robot.
    The space bar is the e-stop. At the end the robot's brain drives again.

    With --leader, the robot's arm moves slowly to the leader's posture, then follows it.
    The leader's motors are switched off. At the end the arm holds its position.

    Args:
        leader: Port of a second SO-101, such as /dev/ttyACM1, that you move by hand.
        leader_calibration: Its calibration file. Default: that of
            `driver calibrate so101 --leader`.
    """
    if leader is not None:
        _follow(leader, leader_calibration, at, take)
        return
    from gigabrain_zenoh.ui.teleop_station import Gamepad, TeleopStation

    async def run() -> None:
        pad = Gamepad()
        try:
            if not sys.stdin.isatty() and pad.pad is None:
                raise ConfigError("teleop needs a terminal or a gamepad; connect one of them")
            async with at.robot(f"{user_name()}-teleop") as robot:
                await TeleopStation(robot, pad).drive(take)
        finally:
            pad.close()

    run_async(run())


def _follow(port: str, calibration: str, at: RobotAddress, take: bool) -> None:
    from gigabrain_drivers.bodies.feetech.leader import LeaderArm
    from gigabrain_zenoh.ui.leader_station import LeaderStation

    async def run() -> None:
        async with LeaderArm(port, calibration) as leader:
            if leader.let_go:
                print_line("the leader's motors are off now: hold it")
            async with at.robot(f"{user_name()}-leader") as robot:
                await LeaderStation(robot, leader, print_line).drive(take)

    run_async(run())


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PageOptions:
    """Address and access of the operator page."""

    port: int = 8080
    "Port to listen on."
    listen: str = "127.0.0.1"
    "Address of this machine to listen on."
    name: tuple[str, ...] = ()
    "Further host name in the page's address; may be given again."
    certificate: Path | None = None
    "TLS certificate, as a PEM file."
    certificate_key: Path | None = None
    "Key of the certificate."
    login: bool = False
    "Require a token on this machine as well."

    def config(self) -> "PageConfig":
        """Return the settings of the process. Raises ConfigError."""
        from gigabrain_zenoh.config.settings import PageConfig

        values = {
            "port": self.port,
            "listen": self.listen,
            "names": self.name,
            "certificate": str(self.certificate or ""),
            "certificate_key": str(self.certificate_key or ""),
            "login": self.login,
            "tell_tokens": True,
        }
        return checked(values, PageConfig)


LOCAL_PAGE = PageOptions()


def page(*, options: PageOptions = LOCAL_PAGE, at: RobotAddress = LOCAL) -> int:
    """Serve the operator page: see and drive the robot in a browser.

    Example: gigabrain page --port 8080

    On a network it needs a certificate, and a token for each visitor:
    one token to drive, one to view. Both are printed when they are made, and
    kept in a file of mode 0600.
    """
    from gigabrain_zenoh.ui.page.access import check
    from gigabrain_zenoh.ui.page.node import INSTALL, installed

    if not installed():
        raise ConfigError(INSTALL)
    config = options.config()
    check(config)
    return _run("page", config, at)


def foxglove(
    *,
    port: int = 8765,
    origin: tuple[str, ...] = (),
    layout: Path | None = None,
    at: RobotAddress = LOCAL,
) -> int:
    """Show the robot live in Foxglove or Lichtblick, at ws://127.0.0.1:8765.

    Example: gigabrain foxglove --layout robot.json

    It serves this machine only: run it where the viewer is. With the layout
    file a viewer may drive from its Teleop panel, so keep that file private.

    Args:
        port: Port to listen on, on loopback.
        origin: Web viewer that may connect, such as https://viewer.example; may be given again.
        layout: Write a layout for the viewer to this file, and exit.
    """
    from gigabrain_zenoh.config.settings import FoxgloveConfig
    from gigabrain_zenoh.ui.foxglove.access import write_layout

    config = checked({"port": port, "origins": origin}, FoxgloveConfig)
    if layout:
        write_layout(config, layout)
        print(f"{layout}: import it as a layout, and open a connection to ws://127.0.0.1:{port}")
        return 0
    return _run("foxglove", config, at)


def view(*, picture: Path | None = None, at: RobotAddress = LOCAL) -> None:
    """Open a live window of the robot's simulation, until it is closed.

    Example: gigabrain view

    A process of its own: the simulation never waits for it. Where there is no
    display, see the 3-D view of the operator page, or save a picture.

    Args:
        picture: Save one picture of the simulation, as it is now, to this PNG file instead.
    """
    from gigabrain_drivers.sim.window import check_display, show
    from gigabrain_zenoh.cli.options import on_bus
    from gigabrain_zenoh.host.files import check_picture_path

    check_picture_path(picture)
    if picture is None:
        check_display()
    on_bus(at, lambda bus: show(bus, picture, print_line), "view")


def _run(name: str, config: Any, at: RobotAddress) -> int:
    import msgspec

    from gigabrain_zenoh.config.settings import ProcessConfig
    from gigabrain_zenoh.launch.processes import run_process
    from gigabrain_zenoh.runtime.running import find_endpoint

    endpoint = find_endpoint(at.connect, at.namespace, at.folder)
    settings = msgspec.to_builtins(config)
    return run_process(ProcessConfig(name=name, endpoint=endpoint, settings=settings))
