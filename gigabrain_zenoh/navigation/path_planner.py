"""Plans paths: over cells for bodies that turn on the spot, over poses for cars."""

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.navigation.car_planner import CarPlanner
from gigabrain_zenoh.navigation.costmap import Costmap
from gigabrain_zenoh.navigation.global_planner import GlobalPlanner, Path, Unreachable
from gigabrain_zenoh.navigation.grid_search import GridSearch


class PathPlanner:
    """Plans with the same buffers each time. It is not thread-safe."""

    def __init__(self) -> None:
        self._cells = GlobalPlanner()
        self._car: CarPlanner | None = None

    @property
    def search(self) -> GridSearch:
        """The search over cells."""
        return self._cells.search

    def plan(
        self, costmap: Costmap, body: BodyDescription, here: Pose, goal: Goal
    ) -> Path | Unreachable:
        """Return the cheapest path to a goal, or why none exists."""
        if body.drive_type == "ackermann":
            return self._car_planner().plan(costmap, body, here, goal)
        return self._cells.plan(costmap, (here.x, here.y), (goal.x, goal.y))

    def replan(
        self, costmap: Costmap, body: BodyDescription, here: Pose, goal: Goal, path: Path
    ) -> Path | Unreachable:
        """Return the rest of `path` if it is still good enough, otherwise a new path."""
        if body.drive_type != "ackermann":
            return self._cells.replan(costmap, (here.x, here.y), (goal.x, goal.y), path)
        if path.headings is None:
            return self._car_planner().plan(costmap, body, here, goal)
        return self._car_planner().replan(costmap, body, here, goal, path)

    def _car_planner(self) -> CarPlanner:
        self._car = self._car or CarPlanner()  # made when needed: it takes about 30 MB
        return self._car
