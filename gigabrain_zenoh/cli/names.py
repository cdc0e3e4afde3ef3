"""`gigabrain robots` and `gigabrain worlds`: what there is to choose from."""


def robots() -> None:
    """List the robots that there are.

    Example: gigabrain robots
    """
    from gigabrain_drivers.driver.catalog import links_of, load_robot, robot_files

    for name, path in robot_files().items():
        robot = load_robot(name)
        links = ", ".join(links_of(robot))
        print(f"{name:<20} {robot.summary} ({links})  {path}")


def worlds() -> None:
    """List the simulated worlds that there are.

    Example: gigabrain worlds
    """
    from gigabrain_drivers.sim.worlds import world_names

    for name, about in world_names().items():
        print(f"{name:<14} {about}")
