"""The class of a thing: pictures from a reliable distance count most, and no single one decides."""

import pytest

from gigabrain_zenoh.perception.class_votes import ClassVotes


def label(*votes: tuple[str, int, float]) -> str:
    """Return the class after votes of class, number of pictures and distance [m]."""
    given = ClassVotes()
    for name, pictures, distance in votes:
        for _ in range(pictures):
            given.add(name, 0.6, distance)
    return given.label


@pytest.mark.parametrize(
    ("votes", "chosen"),
    [
        ([], ""),
        (
            [("can", 5, 1.5), ("cylinder", 500, 0.3)],
            "can",
        ),  # the robot stands in front of it for minutes
        ([("robot", 1, 2.3), ("can", 12, 0.3)], "can"),  # one wrong picture from far away
        ([("robot", 1, 1.5), ("can", 30, 0.3)], "can"),
        ([("robot", 20, 2.6), ("can", 6, 1.5)], "can"),
        ([("robot", 3, 2.6)], "robot"),
        ([("cylinder", 3, 0.3)], "cylinder"),
        ([("cylinder", 60, 1.0), ("can", 61, 1.0)], "can"),  # another thing was put there
    ],
)
def test_the_class_is_that_of_most_pictures_from_a_reliable_distance(
    votes: list[tuple[str, int, float]], chosen: str
) -> None:
    assert label(*votes) == chosen
