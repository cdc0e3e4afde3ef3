"""`gigabrain robots` and `gigabrain worlds`: what there is to choose from."""

from gigabrain_zenoh.plugins import find


def robots() -> None:
    """List the robots that there are.

    Example: gigabrain robots
    """
    for name, path in find("gigabrain_drivers.catalog:robot_files")().items():
        robot = find("gigabrain_drivers.catalog:load_robot")(name)
        links = ", ".join(find("gigabrain_drivers.catalog:links_of")(robot))
        print(f"{name:<20} {robot.summary} ({links})  {path}")


def worlds() -> None:
    """List the simulated worlds that there are.

    Example: gigabrain worlds
    """
    for name, about in find("gigabrain_drivers.sim.worlds:world_names")().items():
        print(f"{name:<14} {about}")
