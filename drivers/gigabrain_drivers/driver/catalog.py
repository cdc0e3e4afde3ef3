"""Finds robots and drivers by name: shipped ones, those of installed packages, and files."""

import difflib
import importlib.util
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec
from msgspec import Struct

from gigabrain_drivers import DRIVERS, shipped_hosts
from gigabrain_drivers.cameras.base import camera_options
from gigabrain_drivers.driver.arm_model import link_names
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import LINKS, LinkOptions, RobotFile, Run
from gigabrain_drivers.lidars.base import check_turns, source_class
from gigabrain_drivers.links.serial_link import AUTO
from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.config.layers import Layers
from gigabrain_zenoh.config.loading import located
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import ConfigError, UnknownName, unknown
from gigabrain_zenoh.geometry.body_settings import check_safe
from gigabrain_zenoh.host.run_folders import state_dir
from gigabrain_zenoh.plugins import load_plugin, offered, plugin_names

GROUP = "gigabrain.drivers"  # group of entry points
EMULATOR = "{emulator}"  # stands for the folder of the emulator's ports in a robot's file
Options = TypeVar("Options", bound=Struct)
EXTRA_OF_PACKAGE = {"can": "can"}  # by missing package; `sim` for all others


def robot_files() -> dict[str, Path]:
    """Return the file of every known robot, by name."""
    bodies = Path(str(resources.files("gigabrain_drivers") / "bodies"))
    ours = {path.parent.name: path for path in sorted(bodies.glob("*/robot.yaml"))}
    return {**_robots_of_packages(), **ours}


def _robots_of_packages() -> dict[str, Path]:
    """Return the robot.yaml of each package that offers a driver, by the driver's name."""
    found = {}
    for point in offered(GROUP):
        spec = importlib.util.find_spec(point.module.partition(".")[0])
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            if (path := Path(folder) / "robot.yaml").is_file():
                found[point.name] = path
    return found


def known_drivers() -> list[str]:
    """Return the names of all drivers: shipped ones, and those of installed packages."""
    return plugin_names(shipped_hosts(DRIVERS), GROUP)


def robot_path(name: str) -> Path:
    """Return the file of a robot: a known name, or a path to a file. Raises ConfigError."""
    if name.endswith((".yaml", ".yml")):
        return Path(name)
    known = robot_files()
    if name not in known:
        package = Path(f"gigabrain-{name.replace('_', '-')}")  # named by `gigabrain driver new`
        if package.is_dir():
            raise UnknownName(
                f"no robot {name!r} yet: its package has to be installed: pip install -e {package}"
            )
        if (file := Path(name) / "robot.yaml").is_file():
            raise UnknownName(f"no robot {name!r}; did you mean {str(file)!r}?")
        raise unknown("robot", name, known)
    return known[name]


def load_robot(name: str) -> RobotFile:
    """Read a robot's file. Raises ConfigError with file, line and what was expected."""
    return config.load(robot_path(name), RobotFile)


def ports_folder(name: str) -> Path:
    """Return the folder of the ports of a robot's emulator (by name or file)."""
    return state_dir() / "ports" / robot_path(name).absolute().parent.name


def robot_links(robot: RobotFile) -> list[LinkName]:
    """Return the links of a robot. A real one with MuJoCo physics can be emulated as well."""
    known = {name for name in LINKS if getattr(robot, name) is not None}
    if robot.real is not None and (robot.sim or {}).get("driver") == "mujoco":
        known.add("emulated")
    return [name for name in LINKS if name in known]


def simulated(link: LinkName) -> list[str]:
    """Return the robots that have `link` and MuJoCo physics, which know the ground truth."""
    known = {name: load_robot(name) for name in robot_files()}
    return [
        name
        for name, robot in known.items()
        if link in robot_links(robot) and robot.sim and robot.sim.get("driver") == "mujoco"
    ]


def driver_class(name: str) -> type[Driver]:
    """Return the driver called `name`: a shipped one, or one of an installed package.

    Raises UnknownName with the known names, and ConfigError if a package is missing.
    """
    try:
        return cast("type[Driver]", load_plugin("driver", name, shipped_hosts(DRIVERS), GROUP))
    except ModuleNotFoundError as error:  # of a shipped driver: few need an extra
        extra = EXTRA_OF_PACKAGE.get(error.name or "", "sim")
        raise ConfigError(
            f"driver {name!r} needs the package {error.name!r}; "
            f"install it with: pip install 'gigabrain-zenoh[{extra}]'"
        ) from None


def make_driver(name: str, run: Run) -> tuple[RobotFile, Driver]:
    """Return the robot called `name` and the driver of its link. Raises ConfigError."""
    robot, driver, options, folder = load_link(name, run)
    try:
        return robot, driver(robot, options, msgspec.structs.replace(run, folder=folder))
    except ConfigError as error:  # in a file that it names, such as a model
        raise located(robot_path(name), error) from None


def load_link(name: str, run: Run) -> tuple[RobotFile, type[Driver], LinkOptions, Path]:
    """Return a robot, the driver of the link of `run`, its options and the file's folder.

    Without a section `emulated`, that link is the `real` one with the emulator's ports. Raises
    ConfigError, also for changes of the file that make the body less safe.
    """
    path = robot_path(name)
    return load_layers(path, robot_layers(path, run.changes), run)


def robot_layers(path: Path, changes: Mapping[str, Any] | None = None) -> Layers:
    """Return the settings of a robot's file, with `changes` of this run. Raises ConfigError."""
    layers = Layers(str(path))
    layers.add(config.document(config.read(path), str(path)), lambda line: f"{path}:{line}")
    if changes:
        layers.add_values(changes, f"{path}, as changed by `robot` of the deployment")
    return layers


def link_type(name: str, link: LinkName) -> type[RobotFile]:
    """Return the type of a robot's file with the options of one link's driver.

    Raises ConfigError.
    """
    path = robot_path(name)
    return _exact_type(path, robot_layers(path), link)


def load_layers(
    path: Path, layers: Layers, run: Run
) -> tuple[RobotFile, type[Driver], LinkOptions, Path]:
    """Return the same as `load_link`, from the layers of a robot's file. Raises ConfigError."""
    robot = layers.convert(RobotFile)
    section, borrowed = _section(robot, run.link)
    driver = _driver_of(path, layers, section, getattr(robot, section))
    # read again with the exact type of the driver's section, so that errors name the line
    options = getattr(layers.convert(_exact_type(path, layers, run.link)), section)
    _check_safe(path, layers, robot)
    _check_links(path, layers, robot)
    if not run.cameras:
        robot = msgspec.structs.replace(robot, cameras=())
    if options.lidar:
        robot = msgspec.structs.replace(robot, lidar=options.lidar)
    if borrowed:
        options = with_ports(options)
    return robot, driver, at_emulator(options, run.emulator), path.parent


def _with_section(section: LinkName, type_: Any) -> type[RobotFile]:
    """Return the type of a robot's file with the exact type of one link's section."""
    exact = msgspec.defstruct(
        "RobotFile",
        [(section, type_)],
        bases=(RobotFile,),
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
    )
    return cast("type[RobotFile]", exact)


def _section(robot: RobotFile, link: LinkName) -> tuple[LinkName, bool]:
    """Return the section of the file for a link, and whether it is that of another link."""
    if link not in robot_links(robot):
        has = ", ".join(robot_links(robot)) or "none"
        raise ConfigError(f"{robot.robot_type} has no link {link!r}; it has: {has}")
    borrowed = link == "emulated" and robot.emulated is None
    return ("real" if borrowed else link), borrowed


def _exact_type(path: Path, layers: Layers, link: LinkName) -> type[RobotFile]:
    robot = layers.convert(RobotFile)
    section, _ = _section(robot, link)
    driver = _driver_of(path, layers, section, getattr(robot, section))
    try:
        own = link_options(driver, robot, getattr(robot, section))
    except ConfigError as error:
        raise located(path, error) from None
    return _with_section(section, own)


def _check_safe(path: Path, layers: Layers, robot: RobotFile) -> None:
    """Raise ConfigError if the layers over a robot's file make the body less safe."""
    try:
        check_safe(config.load(path, RobotFile).description(), robot.description())
    except ValueError as error:
        key = str(error).partition(":")[0]
        raise ConfigError(f"{layers.source_of(key.split('.'))}: {error}") from None


def _check_links(path: Path, layers: Layers, robot: RobotFile) -> None:
    """Raise ConfigError if a camera is on a link that the arm's model does not have."""
    for camera in robot.cameras:
        if not camera.link:
            continue
        known = link_names(path.parent / robot.arm_model, [joint.name for joint in robot.joints])
        if camera.link not in known:
            error = unknown("link", camera.link, known)
            raise ConfigError(f"{layers.source_of(['cameras'])}: camera {camera.name!r}: {error}")


def _driver_of(path: Path, layers: Layers, section: LinkName, link: dict[str, Any]) -> type[Driver]:
    """Return the driver that a link names. Raises ConfigError with file and line."""
    if not isinstance(link.get("driver"), str):
        others = [key for key in link if not difflib.get_close_matches(key, ["driver"])]
        fields: list[tuple[str, Any] | tuple[str, Any, Any]] = [("driver", str)]
        fields += [(key, Any, None) for key in others if key.isidentifier()]
        named = msgspec.defstruct("Link", fields, kw_only=True, forbid_unknown_fields=True)
        layers.convert(_with_section(section, named))  # raises ConfigError
    try:
        return driver_class(link["driver"])
    except ConfigError as error:
        raise located(path, error) from None


def with_ports(options: LinkOptions) -> LinkOptions:
    """Return the options of a real link, with the emulator's ports instead of the real ones."""
    options = msgspec.structs.replace(options, cameras={})  # rendered in the emulator's world
    if hasattr(options, "port"):
        options = msgspec.structs.replace(options, port=f"{EMULATOR}/base")
    if options.scan:
        scan = msgspec.structs.replace(options.scan, port=f"{EMULATOR}/scan")
        options = msgspec.structs.replace(options, scan=scan)
    return options


def at_emulator(options: Options, folder: str) -> Options:
    """Return the options with `{emulator}` replaced by the folder of the emulator's ports."""
    changes: dict[str, Any] = {}
    for field in options.__struct_fields__:
        value = getattr(options, field)
        if isinstance(value, Struct):
            changes[field] = at_emulator(value, folder)
        elif isinstance(value, str) and EMULATOR in value:
            changes[field] = value.replace(EMULATOR, folder)
    return msgspec.structs.replace(options, **changes)


def link_options(driver: type[Driver], robot: RobotFile, link: dict[str, Any]) -> type[LinkOptions]:
    """Return the type of a link's options, including its lidar's, with checks for this body."""
    scan = link.get("scan")
    name = scan.get("driver") if isinstance(scan, dict) else None
    # without a name, the driver's own options refuse the lidar, with the line
    fields: list[Any] = [("scan", source_class(name).Options)] if isinstance(name, str) else []
    if "cameras" in link:
        fields.append(("cameras", camera_options(robot, link["cameras"])))

    def fit(options: LinkOptions) -> None:
        if own := getattr(driver.Options, "__post_init__", None):
            own(options)
        _check_scan(options, robot)
        driver.check(robot, options)

    exact = msgspec.defstruct(
        driver.Options.__name__,
        fields,
        bases=(driver.Options,),
        namespace={"__post_init__": fit},
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
    )
    return cast("type[LinkOptions]", exact)


def _check_scan(options: LinkOptions, robot: RobotFile) -> None:
    """Raise ValueError if a lidar does not fit its port or its description."""
    scan = options.scan
    if scan is None:
        return
    if scan.port == getattr(options, "port", None) != AUTO:
        raise ValueError(f"scan: {scan.port} is the port of the base; expected one of its own")
    try:
        check_turns(scan.driver, options.lidar or robot.lidar)
    except ConfigError as error:
        raise ValueError(f"scan: {error}") from None
