"""`gigabrain view`: a picture of a robot in its world."""

from pathlib import Path


def view(
    *, png: Path, body: str = "turtlebot3_waffle", world: str = "house", seed: int = 0
) -> None:
    """Draw a robot in its world into a PNG file.

    Example: gigabrain view --png waffle.png --world house

    Parameters
    ----------
    png
        The file to write.
    body
        Which robot; see `gigabrain robots`.
    world
        Where it stands; see `gigabrain worlds`.
    seed
        For the pose in which it stands there.
    """
    from gigabrain_drivers.sim.portrait import portray

    portray(body, world, seed, png)
    print(png)
