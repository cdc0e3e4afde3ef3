"""Compile whatever a driving robot calls, before it drives."""

import numpy as np

from gigabrain_zenoh.geometry.se2 import IDENTITY
from gigabrain_zenoh.mapping import grid
from gigabrain_zenoh.mapping.field import contradiction, field_of
from gigabrain_zenoh.mapping.points import Scan
from gigabrain_zenoh.mapping.relocalize import search

BEAMS, ROOM_M = 60, 1.0


def warm_up() -> None:
    """Call every kernel of making a map once."""
    from gigabrain_zenoh.mapping.slam import Slam  # and gtsam: only who makes maps pays

    warm_up_finding()
    along = np.linspace(-3.0, 3.0, 60)
    walls = np.concatenate([np.c_[along, along * 0 + 3.0], np.c_[along * 0 + 3.0, along]])
    slam, scan = Slam(), Scan.of(walls)
    slam.add(scan, IDENTITY)
    slam.add(scan, IDENTITY)
    slam.add(Scan.of(walls / 2), IDENTITY)  # fits nowhere


def warm_up_finding() -> None:
    """Call every kernel of finding the way in a map once, in a room of 2 x 2 m."""
    angles = np.linspace(0.0, 2 * np.pi, BEAMS, endpoint=False)
    ways = np.column_stack((np.cos(angles), np.sin(angles)))
    scan = Scan.of(ROOM_M * ways / np.abs(ways).max(axis=1, keepdims=True), ways[:1])
    grid.warm_up()
    drawn = grid.Grid()
    drawn.draw(IDENTITY, scan.points, scan.free)
    field = field_of(drawn.percent(), grid.CELL, (drawn.origin_x, drawn.origin_y))
    sensor = np.zeros(2)
    search(field, scan.points, scan.free, sensor)
    contradiction(field, scan.points, scan.free, sensor, np.zeros(3))
