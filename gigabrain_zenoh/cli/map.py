"""`gigabrain map`: save the map that a robot makes, and look at saved ones."""

from gigabrain_zenoh.cli.where import HERE, Which, say
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused
from gigabrain_zenoh.host.signals import run_async

PATIENCE_S = 20.0  # a large map takes a while to write


def save(name: str, /, *, at: Which = HERE, replace: bool = False) -> int:
    """Save the map that perception makes, where perception runs.

    Example: gigabrain map save office

    An empty map is refused, and one in which the robot does not know where it is.

    Parameters
    ----------
    name
        Of the files: NAME.yaml and NAME.pgm for ROS, NAME.graph.npz to go on with.
    replace
        Another map of that name.
    """
    import getpass

    import msgspec

    from gigabrain_schemas.requests import MapRequest
    from gigabrain_schemas.topics import MAP_SAVE
    from gigabrain_zenoh.diagnostics.hearing import NAME
    from gigabrain_zenoh.runtime.connect import joined

    try:
        fields = {"name": name, "replace": replace, "source": getpass.getuser()}
        request = msgspec.convert(fields, MapRequest)
    except msgspec.ValidationError:
        raise ConfigError(
            f"no name for a map: {name!r}; expected letters, digits, - _ . and no ending"
        ) from None

    async def ask() -> None:
        async with joined(at.where(), NAME) as (bus, _):
            replies = await bus.ask(MAP_SAVE, request, timeout_s=PATIENCE_S)
        if not replies:
            raise BodyLost(
                "nobody makes a map: perception needs `mapping: slam`; or may your keys not ask?"
            )
        if not replies[0].ok:
            raise Refused(replies[0].text)
        say(replies[0].text)

    run_async(ask())
    return 0


def info(name: str, /) -> int:
    """Check a saved map, and tell its size.

    Example: gigabrain map info office

    Parameters
    ----------
    name
        Its name, or the path of its YAML file.
    """
    from gigabrain_zenoh.mapping import map_file

    path = map_file.path_of(name)
    saved = map_file.load(path)
    if problem := map_file.what_is_wrong(saved):
        raise ConfigError(f"{path}: {problem}")
    say(f"{path}: {map_file.in_words(saved)}, {saved.resolution:g} m a cell")
    if path.with_suffix(map_file.GRAPH).exists():
        graph = map_file.load_graph(path)
        if (poses := graph.get("poses")) is None or poses.ndim != 2:
            raise ConfigError(f"{path.with_suffix(map_file.GRAPH)}: no pose graph")
        say(f"pose graph: {len(poses)} keyframes; mapping can go on from it")
    else:
        say("no pose graph: the robot can find its way in it, but not go on mapping")
    return 0
