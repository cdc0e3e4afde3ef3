"""`gigabrain foxglove`: the robot in Foxglove or Lichtblick, live."""

from pathlib import Path

from gigabrain_zenoh.cli.where import HERE, Which


def foxglove(
    *,
    port: int = 8765,
    origin: tuple[str, ...] = (),
    layout: Path | None = None,
    at: Which = HERE,
) -> int:
    """Show the robot in Foxglove or Lichtblick, live, at ws://127.0.0.1:8765.

    Example: gigabrain foxglove --layout robot.json

    It serves this machine alone: run it where you look, also when the robot is elsewhere. Whoever
    has the layout file may steer from its Teleop panel.

    Parameters
    ----------
    port
        Where it listens, on loopback.
    origin
        A site whose pages may connect, such as https://viewer.example, beside the known viewers.
    layout
        Write a layout for the viewer into this file, to be imported there, and do nothing else.
    """
    import msgspec

    from gigabrain_zenoh.cli.checked import checked
    from gigabrain_zenoh.config.settings import FoxgloveConfig, ProcessConfig
    from gigabrain_zenoh.launch.processes import run_process
    from gigabrain_zenoh.runtime.running import find_endpoint
    from gigabrain_zenoh.ui.foxglove.access import write_layout

    config = checked({"port": port, "origins": origin}, FoxgloveConfig)
    if layout:
        write_layout(config, layout)
        print(f"{layout}: import it as a layout, and open a connection to ws://127.0.0.1:{port}")
        return 0
    endpoint = find_endpoint(at.connect, at.namespace, at.folder)
    settings = msgspec.to_builtins(config)
    return run_process(ProcessConfig(name="foxglove", endpoint=endpoint, settings=settings))
