"""What each role may say, ask and answer: on a real router, over TLS, key by key."""

from gigabrain_schemas.topics import SERVICES, TOPICS
from gigabrain_zenoh.security.acl import RIGHTS, access_control, known_names


def test_every_topic_and_service_has_somebody_who_may_use_it() -> None:
    """A topic that is new has to be somebody's: else it would be the robot's alone, unnoticed."""
    said = {topic for rights in RIGHTS.values() if rights for topic in rights.says}
    only_the_robot = {topic.key for topic in TOPICS if topic not in said}
    assert only_the_robot == {
        "robot/scan", "robot/imu", "robot/state", "robot/body", "robot/image", "robot/safety",
        "robot/audit",
    }  # fmt: skip
    asked = {service for rights in RIGHTS.values() if rights for service in rights.asks}
    assert asked == set(SERVICES)


def test_a_router_without_keys_has_no_rules_and_with_them_denies_by_default() -> None:
    rules = access_control(["red"], {}, "red")
    assert rules["default_permission"] == "deny"
    assert {policy["subjects"][0] for policy in rules["policies"]} == {
        "local", "robot@red", "brain@red", "operator@red", "viewer@red", "operator", "viewer",
    }  # fmt: skip
    assert known_names(["red"]) == (
        "robot@red", "brain@red", "operator", "operator@red", "viewer", "viewer@red",
    )  # fmt: skip
    assert known_names([""]) == ("robot", "brain", "operator", "viewer")
