"""Pose hints from a person or RViz, and their covariance."""

import numpy as np
import pytest

from gigabrain_schemas.requests import PoseRequest
from gigabrain_schemas.topics import POSE_SET
from gigabrain_zenoh.mapping.odometry import OdometrySample
from gigabrain_zenoh.perception.pose_hints import PoseHints
from gigabrain_zenoh.testing.in_memory import Net

HERE = OdometrySample(10, np.zeros(3), np.zeros(3), False, 0)


async def said(request):
    """Return the reply to a request, and the covariance of the hint that it makes."""
    net = Net()
    hints = PoseHints(net.one, lambda: HERE, lambda _: None)
    (reply,) = await net.two.ask(POSE_SET, request)
    hint = hints.at(HERE)
    return reply, None if hint is None else hint.covariance


async def test_a_given_covariance_is_used():
    request = PoseRequest(
        x=1.0, y=2.0, yaw=0.5, covariance=(0.25, 0.0, 0.01, 0.0, 0.36, 0.0, 0.01, 0.0, 0.07)
    )
    reply, spread = await said(request)
    assert reply.ok
    expected = [[0.25, 0.0, 0.01], [0.0, 0.36, 0.0], [0.01, 0.0, 0.07]]
    assert spread == pytest.approx(np.array(expected), abs=2e-6)


async def test_without_a_covariance_that_of_a_person_is_used():
    _, spread = await said(PoseRequest(x=1.0, y=2.0, yaw=0.5))
    assert spread == pytest.approx(np.diag((0.09, 0.09, 0.0625)))


async def test_without_a_yaw_any_heading_is_searched():
    given = (0.04, 0.0, 0.01, 0.0, 0.04, 0.0, 0.01, 0.0, 0.01)
    _, spread = await said(PoseRequest(x=0.0, y=0.0, covariance=given))
    assert spread == pytest.approx(np.diag((0.04, 0.04, (np.pi / 2) ** 2)), abs=2e-6)


async def test_a_covariance_of_zeros_is_enlarged_for_the_search():
    _, spread = await said(PoseRequest(x=0.0, y=0.0, yaw=0.0, covariance=(0.0,) * 9))
    assert np.linalg.eigvalsh(spread).min() > 0


async def test_a_covariance_with_a_negative_eigenvalue_is_refused():
    given = (0.1, 0.0, 0.0, 0.0, -0.1, 0.0, 0.0, 0.0, 0.1)
    reply, spread = await said(PoseRequest(x=0.0, y=0.0, yaw=0.0, covariance=given))
    assert not reply.ok
    assert "covariance" in reply.text
    assert spread is None


def test_a_covariance_of_another_length_is_no_request():
    with pytest.raises(ValueError, match="9 values"):
        PoseRequest(x=0.0, y=0.0, covariance=(0.1, 0.2))
