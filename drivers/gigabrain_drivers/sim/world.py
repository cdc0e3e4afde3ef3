"""What a world is: upright shapes in a walled rectangle, perhaps a person, and where to start."""

from dataclasses import dataclass

from gigabrain_drivers.sim.geometry import Box, Pose, Shape

WALL_HEIGHT = 0.6  # [m], well above the plane of any lidar here
WALL_HALF = 0.05  # [m]

ORIGIN = Pose(0.0, 0.0, 0.0)

Corners = tuple[tuple[float, float], ...]
Colour = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class World:
    """A place for a robot; the origin is in its middle. Lengths in metres."""

    name: str
    description: str
    half_x: float  # to the inner face of the outer walls
    half_y: float
    shapes: tuple[Shape, ...]  # all but the outer walls
    wall_height: float = WALL_HEIGHT
    floor: tuple[Colour, Colour] = ((0.62, 0.66, 0.70), (0.58, 0.62, 0.66))  # its two checks
    check: tuple[float, float] = (0.5, 0.5)  # size of one
    path: Corners = ()  # the person's, closed; empty: nobody is there
    start: Pose = ORIGIN  # of the robot
    person_start: float = 0.0  # along the path [m]

    def walls(self) -> tuple[Box, ...]:
        """The four outer walls."""
        x, y, half, height = self.half_x, self.half_y, WALL_HALF, self.wall_height
        return (
            Box(0, y + half, x + 2 * half, half, height),
            Box(0, -y - half, x + 2 * half, half, height),
            Box(x + half, 0, half, y, height),
            Box(-x - half, 0, half, y, height),
        )

    def everything(self) -> tuple[Shape, ...]:
        """All shapes, the outer walls included."""
        return (*self.walls(), *self.shapes)
