"""The class of a thing: pictures from a fitting distance count most, and no single one decides."""

import pytest

from gigabrain_zenoh.perception.class_votes import ClassVotes


def label(*votes: tuple[str, int, float]) -> str:
    """The class after so many pictures of each, from a distance [m]."""
    given = ClassVotes()
    for name, pictures, distance in votes:
        for _ in range(pictures):
            given.add(name, 0.6, distance)
    return given.label


@pytest.mark.parametrize(
    ("votes", "chosen"),
    [
        ([], ""),
        ([("can", 5, 1.5), ("cylinder", 500, 0.3)], "can"),  # it stands before it for minutes
        ([("robot", 1, 2.3), ("can", 12, 0.3)], "can"),  # a wrong glimpse from far off
        ([("robot", 1, 1.5), ("can", 30, 0.3)], "can"),
        ([("robot", 20, 2.6), ("can", 6, 1.5)], "can"),
        ([("robot", 3, 2.6)], "robot"),
        ([("cylinder", 3, 0.3)], "cylinder"),
        ([("cylinder", 60, 1.0), ("can", 61, 1.0)], "can"),  # it was put there since
    ],
)
def test_the_class_is_that_of_most_pictures_from_where_a_net_is_sure(
    votes: list[tuple[str, int, float]], chosen: str
) -> None:
    assert label(*votes) == chosen
