"""Zenoh publishers and subscribers with a history, declared as `rmw_zenoh` declares them."""

from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from gigabrain_zenoh.ros2.qos import Qos

REMOTE = zenoh.Locality.REMOTE


def advanced_publisher(session: zenoh.Session, key: str, qos: Qos) -> Any:
    """Declare a publisher that keeps its last messages for late readers.

    It has no heartbeat, so a reader does not notice that it missed the last message. Zenoh 1.10
    stops the heartbeat's task while holding the GIL, which hangs if a callback waits for the GIL.
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
    """Declare a subscriber; a transient local one also requests the messages that it missed."""
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
