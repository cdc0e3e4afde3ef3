"""Zones on the cells of a map: what is forbidden, and what odd polygons do."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gigabrain_schemas.base import Pose
from gigabrain_schemas.zones import Zone
from gigabrain_zenoh.geometry import polygon
from gigabrain_zenoh.navigation.block_bounds import COLUMN_STEPS, ROW_STEPS
from gigabrain_zenoh.navigation.costmap import LETHAL, Inflation, costmap, with_zones
from gigabrain_zenoh.navigation.global_planner import GlobalPlanner, Path, Unreachable, is_valid
from gigabrain_zenoh.navigation.local_costmap import LocalCostmap, Pose2D
from gigabrain_zenoh.navigation.zones import ZoneMap, fill
from tests.unit.navigation.grids import empty, grid_of

RULES = Inflation(fits=0.2, turns=0.3)
SQUARE = ((1.0, 1.0), (2.0, 1.0), (2.0, 2.0), (1.0, 2.0))
coordinate = st.one_of(st.floats(-20, 20), st.floats(-1e5, 1e5))
corners = st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=20)


def keepout(*points: tuple[float, float], name: str = "lab") -> Zone:
    return Zone(name=name, kind="keepout", points=points)


def lane(*points: tuple[float, float], width: float = 1.0) -> Zone:
    return Zone(name="lane", kind="one_way", points=points, lane_width=width)


def costs_with(*zones: Zone, size: float = 10.0) -> "tuple[np.ndarray, np.ndarray]":
    grid = grid_of(empty(size, size))
    zoned = with_zones(costmap(grid, RULES), ZoneMap(zones).overlay(grid, RULES))
    return zoned.cost, zoned.against


def test_cells_too_close_to_a_zone_are_lethal_but_not_more() -> None:
    cost, _ = costs_with(keepout(*SQUARE))
    rows, columns = np.mgrid[:100, :100]
    centres = np.column_stack((columns.ravel(), rows.ravel())) * 0.1 + 0.05
    away = polygon.distance(np.array(SQUARE), centres).reshape(100, 100)
    assert (cost[away < 0.2 - 0.05] == LETHAL).all()
    assert (cost[away > 0.2 + 0.15] < LETHAL).all()
    assert cost.max() == LETHAL


def test_a_wall_in_a_zone_stays_closed_to_a_body_that_leaves_it() -> None:
    cells = empty(6.0, 6.0)
    cells[10:50, 20] = 100
    grid = grid_of(cells)
    zoned = with_zones(
        costmap(grid, RULES),
        ZoneMap([keepout((0.5, 0.5), (5.5, 0.5), (5.5, 5.5), (0.5, 5.5))]).overlay(grid, RULES),
    )
    path = GlobalPlanner().plan(zoned, (2.6, 3.0), (0.15, 3.0))
    assert isinstance(path, Path)
    assert np.abs(path.points[:, 1] - 3.0).max() > 2.0  # round the wall


@given(points=corners)
@settings(max_examples=60, deadline=None)
def test_any_polygon_fills_the_cells_that_it_covers(points: list[tuple[float, float]]) -> None:
    shape, cells = np.array(points), np.zeros((40, 40), np.uint8)
    fill(cells, shape, 1)
    rows, columns = np.mgrid[:40, :40]
    centres = np.column_stack((columns.ravel(), rows.ravel())) + 0.5
    inside = polygon.contains(shape, centres).reshape(40, 40)
    edge = polygon.distance(shape, centres).reshape(40, 40)
    begin, along = shape, np.roll(shape, -1, axis=0) - shape
    off = centres[:, None] - begin
    share = ((off * along).sum(2) / np.maximum((along**2).sum(1), 1e-12)).clip(0, 1)
    rim = np.hypot(*np.moveaxis(off - share[..., None] * along, 2, 0)).min(1).reshape(40, 40)
    assert (cells[inside & (rim > 1.0)] == 1).all()
    assert (cells[edge > 2.0] == 0).all()


@given(points=corners)
@settings(max_examples=100, deadline=None)
def test_crossing_edges_are_found_as_by_comparing_all_pairs(
    points: list[tuple[float, float]],
) -> None:
    shape = np.round(np.array(points))
    ends = np.roll(shape, -1, axis=0)

    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> int:
        turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        return int(np.sign(turn))

    def boxes(i: int, j: int) -> bool:
        return bool(
            (np.maximum(shape[i], ends[i]) >= np.minimum(shape[j], ends[j])).all()
            and (np.maximum(shape[j], ends[j]) >= np.minimum(shape[i], ends[i])).all()
        )

    count = len(shape)
    crossing = any(
        boxes(i, j)
        and side(shape[i], ends[i], shape[j]) * side(shape[i], ends[i], ends[j]) <= 0
        and side(shape[j], ends[j], shape[i]) * side(shape[j], ends[j], ends[i]) <= 0
        for i in range(count)
        for j in range(i + 2, count)
        if (i, j) != (0, count - 1)
    )
    assert polygon.edges_cross(shape) == crossing


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (((0, 0), (1, 1), (1, 0), (0, 1)), "its edges cross"),
        (((0, 0), (1, 0), (2, 0)), "it has no area"),
        (((5, 5), (5, 5), (5, 5)), "it has no area"),
        (((0, 0), (1, 0), (1, 1), (0, 1)), ""),
        (((1e5, 1e5), (1e5 - 1, 1e5), (1e5, 1e5 - 1)), ""),
    ],
)
def test_only_simple_polygons_are_accepted(
    points: tuple[tuple[float, float], ...], why: str
) -> None:
    assert polygon.problem(np.array(points, float)) == why


@pytest.mark.parametrize("heading", np.linspace(-math.pi, math.pi, 33))
def test_no_mix_of_allowed_ways_goes_back_along_a_lane(heading: float) -> None:
    """A zigzag cannot lead back: the allowed ways that lead back are all on one side."""
    ahead = np.array((math.cos(heading), math.sin(heading)))
    _, against = costs_with(lane((5 - 3 * ahead[0], 5 - 3 * ahead[1]), (5 + 3 * ahead[0],
                                 5 + 3 * ahead[1]), width=2.0))  # fmt: skip
    forbidden = int(against[50, 50])
    assert forbidden
    steps = [np.array((c, r), float) for r, c in zip(ROW_STEPS, COLUMN_STEPS, strict=True)]
    allowed = [step for way, step in enumerate(steps) if not forbidden >> way & 1]
    aside = np.array((-ahead[1], ahead[0]))
    back = [step for step in allowed if step @ ahead < -1e-9]
    for one in back:
        for other in allowed:
            if (one @ aside) * (other @ aside) < 0:  # sideways they cancel
                share = abs(one @ aside) / abs(other @ aside)
                assert (one + share * other) @ ahead > -1e-6


def test_paths_lead_along_lanes_and_past_them_but_not_against_them() -> None:
    grid = grid_of(empty(10.0, 10.0))
    zones = ZoneMap([lane((2.0, 5.0), (8.0, 5.0), width=2.0)])
    zoned = with_zones(costmap(grid, RULES), zones.overlay(grid, RULES))
    planner = GlobalPlanner()
    along = planner.plan(zoned, (1.0, 5.0), (9.0, 5.0))
    against = planner.plan(zoned, (9.0, 5.0), (1.0, 5.0))
    across = planner.plan(zoned, (5.0, 2.0), (5.0, 8.0))
    assert isinstance(along, Path)
    assert isinstance(against, Path)
    assert isinstance(across, Path)
    assert along.remaining[0] == pytest.approx(8.0, abs=0.05)
    assert across.remaining[0] == pytest.approx(6.0, abs=0.05)
    middle = against.points[(against.points[:, 0] > 2.2) & (against.points[:, 0] < 7.8)]
    assert (np.abs(middle[:, 1] - 5.0) > 0.9).all()
    assert is_valid(against, zoned)
    assert not is_valid(along.__class__(points=along.points[::-1], remaining=along.remaining,
                                        cost=along.cost), zoned)  # fmt: skip
    shut = with_zones(
        costmap(grid, RULES),
        ZoneMap([lane((2.0, 5.0), (8.0, 5.0), width=12.0)]).overlay(grid, RULES),
    )
    assert isinstance(planner.plan(shut, (9.0, 5.0), (1.0, 5.0)), Unreachable)


def test_the_allowed_speed_falls_before_the_body_reaches_the_zone() -> None:
    zones = ZoneMap([Zone(name="ramp", kind="speed", max_speed=0.2,
                          points=((3.0, -1.0), (5.0, -1.0), (5.0, 1.0), (3.0, 1.0)))])  # fmt: skip
    footprint = ((0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.2, -0.2))
    path = np.column_stack((np.arange(0.0, 8.0, 0.1), np.zeros(80)))

    def allowed(x: float, speed: float) -> float:
        cap = zones.speed_cap(Pose(x=x, y=0.0, yaw=0.0), footprint, path[path[:, 0] >= x], speed, 1)
        return cap.speed if cap else math.inf

    assert allowed(0.0, 1.0) > 0.7
    assert allowed(2.0, 1.0) < allowed(1.0, 1.0)
    assert allowed(2.75, 0.2) < 0.3
    assert allowed(3.5, 1.0) == 0.2
    assert allowed(5.1, 0.2) == 0.2  # its rear is still in the zone
    assert allowed(5.3, 0.2) == math.inf


def test_a_body_in_a_zone_may_leave_it_but_not_go_deeper() -> None:
    window = LocalCostmap(6.0, 10.0)
    nothing = np.empty((0, 2))
    window.add_scan(1, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), nothing)
    zone = np.array(((-1.0, -1.0), (4.0, -1.0), (4.0, 1.0), (-1.0, 1.0)))
    far = np.array(((2.0, 2.0), (2.5, 2.0), (2.5, 2.5), (2.0, 2.5)))
    body = np.array(((-0.9, 0.1), (-0.7, 0.1), (-0.7, -0.1), (-0.9, -0.1)))
    grid = window.grid(1, nothing, np.empty((0, 6)), (zone, far), body)

    def near(x: float, y: float) -> float:
        return float(grid.distance[int((y - grid.y) / grid.cell), int((x - grid.x) / grid.cell)])

    assert near(-0.8, 0.0) > 0.0  # at its place
    assert near(-1.5, 0.0) > 0.0  # on its way out
    assert near(0.5, 0.0) == 0.0
    assert near(2.2, 2.2) == 0.0  # another zone is closed up to its rim
    outside = window.grid(1, nothing, np.empty((0, 6)), (zone, far), body - (1.0, 0.0))
    assert outside.distance[int((0.0 - grid.y) / grid.cell), int((-0.9 - grid.x) / grid.cell)] == 0
