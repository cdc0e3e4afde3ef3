"""Access rights of the roles: topics, services, and rules for the router."""

from gigabrain_schemas.safety import ButtonState
from gigabrain_schemas.topics import SERVICES, TOPICS, Topic
from gigabrain_zenoh.security.acl import PUBLISHED, Table, access_control, known_names


def test_every_topic_and_service_has_somebody_who_may_use_it() -> None:
    """A topic that is new has to be somebody's: else it would be the robot's alone, unnoticed."""
    only_the_robot = {topic.key for topic in TOPICS if not topic.publishers}
    assert only_the_robot == {
        "robot/scan", "robot/imu", "robot/state", "robot/body", "robot/arm_model", "robot/image",
        "robot/depth", "robot/camera", "robot/safety", "robot/audit", "robot/sim_scene",
        "robot/sim_poses",
    }  # fmt: skip
    assert [service.key for service in SERVICES if not service.callers] == []


def test_a_topic_declares_who_may_publish_it() -> None:
    bell = Topic("robot/bell", ButtonState, 1, many=True, publishers=("operator",))
    table = Table({"operator": ("page",), "brain": ("decision",)}, (*PUBLISHED, bell))
    rules = {rule["id"]: rule["key_exprs"] for rule in access_control(["red"], table)["rules"]}
    assert "red/robot/bell/page" in rules["operator@red says"]
    assert not any("bell" in key for key in rules["brain@red says"])
    assert "viewer@red says" not in rules


def test_a_router_without_keys_has_no_rules_and_with_them_denies_by_default() -> None:
    rules = access_control(["red"], Table({}), "red")
    assert rules["default_permission"] == "deny"
    assert {policy["subjects"][0] for policy in rules["policies"]} == {
        "local", "robot@red", "brain@red", "operator@red", "viewer@red", "dispatcher@red",
        "operator", "viewer", "dispatcher",
    }  # fmt: skip
    assert known_names(["red"]) == (
        "robot@red", "brain@red", "operator", "operator@red", "viewer", "viewer@red",
        "dispatcher", "dispatcher@red",
    )  # fmt: skip
    assert known_names([""]) == ("robot", "brain", "operator", "viewer", "dispatcher")


def test_open_rmfs_adapter_reads_and_asks_what_free_fleet_needs_and_nothing_else() -> None:
    rules = {rule["id"]: rule for rule in access_control(["red"], Table({}))["rules"]}
    ours = {name: rule for name, rule in rules.items() if name.startswith("dispatcher@red")}
    keys = ["red/battery_state", "red/navigate_to_pose/_action/*", "red/tf"]
    assert ours.keys() == {
        "dispatcher@red hears", "dispatcher@red is heard", "dispatcher@red listens",
        "dispatcher@red asks",
    }  # fmt: skip
    assert ours["dispatcher@red hears"]["key_exprs"] == keys
    assert ours["dispatcher@red listens"]["key_exprs"] == keys
    assert ours["dispatcher@red asks"]["key_exprs"] == ["red/navigate_to_pose/_action/*"]
    for role in ("brain", "operator", "viewer"):
        assert not any("_action" in key for key in rules[f"{role}@red asks"]["key_exprs"])
