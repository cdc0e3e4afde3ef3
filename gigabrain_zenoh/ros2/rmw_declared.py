"""Zenoh declarations as `rmw_zenoh` makes them: publishers and subscribers with a history."""

from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from gigabrain_zenoh.ros2.qos import Qos

REMOTE = zenoh.Locality.REMOTE


def advanced_publisher(session: zenoh.Session, key: str, qos: Qos) -> Any:
    """Declare a publisher that keeps its last messages for late readers.

    It has no heartbeat, by which readers notice that they missed the last message: Zenoh 1.10 ends
    its task while it holds the GIL, and hangs where a callback waits for that.
    """
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        congestion_control=zenoh.CongestionControl.DROP,
        allowed_destination=REMOTE,
        cache=zenoh.ext.CacheConfig(qos.depth),
        publisher_detection=True,
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
        if qos.reliable
        else None,
    )


def subscriber(
    session: zenoh.Session, key: str, qos: Qos, put: Callable[[zenoh.Sample], None]
) -> Any:
    """Declare a subscriber; of transient local data one that asks for what it missed."""
    if not qos.transient_local:
        return session.declare_subscriber(key, put, allowed_origin=REMOTE)
    return zenoh.ext.declare_advanced_subscriber(
        session,
        key,
        put,
        allowed_origin=REMOTE,
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth),
        recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        if qos.reliable
        else None,
    )
