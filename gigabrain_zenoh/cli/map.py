"""`gigabrain map`: saves, lists, loads and checks maps; `precompile`: compiles the kernels."""

import asyncio
import time

from gigabrain_zenoh.cli.options import LOCAL, RobotAddress, checked, on_bus, print_line
from gigabrain_zenoh.errors import ConfigError, GigabrainError
from gigabrain_zenoh.host.signals import run_async

NOT_LINKED = (
    "not linked: that needs a C++ compiler, Python.h, and pip install 'gigabrain-zenoh[fast]'"
)


def save(name: str, /, *, at: RobotAddress = LOCAL, replace: bool = False) -> None:
    """Save the map that the robot makes, on the host where perception runs.

    Example: gigabrain map save office

    It is refused if the map is empty, or if the robot is not localized.

    Args:
        name: Name of the files: NAME.yaml and NAME.pgm for ROS, NAME.graph.npz to continue.
        replace: Replace a map of the same name.
    """
    from gigabrain_schemas.requests import MapRequest
    from gigabrain_zenoh.client.zones import save_map
    from gigabrain_zenoh.host.this_process import user_name

    checked({"name": name}, MapRequest, positional=("name",))
    user = user_name()
    print_line(on_bus(at, lambda bus: save_map(bus, name, replace=replace, source=user)))


def list_() -> None:
    """List the saved maps of this machine.

    Example: gigabrain map list
    """
    from gigabrain_zenoh.mapping import map_file
    from gigabrain_zenoh.mapping.map_list import as_line, saved_maps

    maps, more = saved_maps()
    for one in maps:
        print_line(as_line(one))
    if more:
        print_line(f"{more} more in {map_file.folder()}")
    if not maps:
        print_line(f"no maps in {map_file.folder()}; save one with `gigabrain map save NAME`")


def load(name: str, /, *, proceed: bool = False, at: RobotAddress = LOCAL) -> None:
    """Let a running robot use a saved map of perception's host.

    Example: gigabrain map load office

    All tasks are cancelled: their coordinates are of the old map. The robot then localizes itself.

    Args:
        name: Name of the map.
        proceed: Continue mapping from it. Default: only localize in it.
    """
    from gigabrain_schemas.zones import MapLoadRequest
    from gigabrain_zenoh.client.zones import load_map
    from gigabrain_zenoh.host.this_process import user_name

    checked({"name": name}, MapLoadRequest, positional=("name",))
    user, mapping = user_name(), "slam" if proceed else "localize"
    print_line(on_bus(at, lambda bus: load_map(bus, name, mapping=mapping, source=user)))


def info(name: str, /) -> None:
    """Check a saved map, and print its size.

    Example: gigabrain map info office

    Args:
        name: Name of the map, or path of its YAML file.
    """
    from gigabrain_zenoh.mapping import map_file, zone_file

    path = map_file.path_of(name)
    saved = map_file.load(path)
    if problem := map_file.map_problem(saved):
        raise ConfigError(f"{path}: {problem}")
    print_line(f"{path}: {map_file.in_words(saved)}, {saved.resolution:g} m per cell")
    zones = zone_file.load(path)
    if zones.zones or zones.places:
        print_line(zone_file.listed(len(zones.zones), len(zones.places)))
    if not path.with_suffix(map_file.GRAPH).exists():
        print_line("no pose graph: usable for localization, not to continue mapping")
        return
    poses = map_file.load_graph(path).get("poses")
    if poses is None or poses.ndim != 2:
        raise ConfigError(f"{path.with_suffix(map_file.GRAPH)}: no pose graph")
    print_line(f"pose graph: {len(poses)} keyframes; mapping can continue from it")


def precompile() -> None:
    """Compile mapping and navigation, so that the first start is as quick as every other.

    Example: gigabrain precompile

    The compiled code is kept in the user's cache folder, or in NUMBA_CACHE_DIR.
    After an update it is compiled again, at the latest at the first start, while
    the robot drives.

    With a C++ compiler and the extra `fast` it is linked as well: robots then
    start faster and take 100 MB less. Only this command does that.
    """
    run_async(_compile_all())


async def _compile_all() -> None:
    from gigabrain_zenoh.decision.drive_kernels import ARM_KERNELS, CAR_KERNELS, DRIVE_KERNELS
    from gigabrain_zenoh.kernels.precompile import can_link
    from gigabrain_zenoh.perception.node import LOCALIZE_KERNELS, MAP_KERNELS

    print_line("compiling, which takes up to two minutes")
    links = can_link()
    await asyncio.gather(  # these share no kernel
        _compile("mapping", MAP_KERNELS, LOCALIZE_KERNELS, links=links),
        _compile("driving", DRIVE_KERNELS, CAR_KERNELS, ARM_KERNELS, links=links),
    )
    if not links:
        print_line(NOT_LINKED)


async def _compile(name: str, *warm_ups: str, links: bool) -> None:
    from gigabrain_zenoh.kernels import cache
    from gigabrain_zenoh.kernels import precompile as kernels

    start_s, before = time.monotonic(), cache.digest(cache.PACKAGE)
    for warm_up in warm_ups:
        if await kernels.compile_in_child(warm_up):
            try:
                kernels.compile_all(warm_up)  # raises the reason of the failure
            except ModuleNotFoundError as error:
                raise kernels.missing_package(error) from None
    if cache.digest.__wrapped__(cache.PACKAGE) != before:  # read again, not cached
        raise GigabrainError(
            f"{name}: sources changed while they were compiled; run `gigabrain precompile` again"
        )
    if not all(map(kernels.is_kept, warm_ups)):
        raise ConfigError(
            f"{name}: compiled, but not kept: cannot write {cache.kernel_folder()}; "
            f"make room there, or name another folder with {cache.FOLDER}"
        )
    if links:
        await kernels.link_in_child(name, *warm_ups)
    print_line(f"{name}: {time.monotonic() - start_s:.1f} s")
