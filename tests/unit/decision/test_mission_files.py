"""Files of missions and patrols: valid contents and refusals."""

from pathlib import Path

import pytest

from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.zones import Place
from gigabrain_zenoh.decision.tasks import mission as missions
from gigabrain_zenoh.decision.tasks import mission_files
from gigabrain_zenoh.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("do: []", "m:1: do: expected a list of length >= 1, got a list of 0"),
        ("do:\n- gotoo: a", "m:2: unknown field 'gotoo'; did you mean 'goto'? known: "),
        ("do:\n- goto: a", "m:2: do[0].goto: no place 'a'; known: none"),
        (
            "places: {kitchen: [1, 2]}\ndo:\n- wait: 1\n- patrol: {points: [kichen]}",
            "m:4: do[1].patrol.points[0]: no place 'kichen'; did you mean 'kitchen'?",
        ),
        ("do:\n- goto: [1, .nan]", "m:2: .nan is not allowed; expected a finite number"),
        ("do:\n- goto: [1]", "m:2: do[0].goto: expected "),
        ("do:\n- goto: [1, 2, 2e6]", "m:2: do[0].goto[2]: expected a number >= -1000000.0 and"),
        (
            "do:\n- wait: 1\n- patrol: {points: [[1, 2], [2e5, 1]]}",
            "m:3: do[1].patrol.points[1][0]: expected -100000 to 100000 [m], got 200000",
        ),
        (
            "do: [{battery_below: {percentage: 9, goto: [0, -2e5], do: [{wait: 1}]}}]",
            "m:1: do[0].battery_below.goto[1]: expected -100000 to 100000 [m], got -200000",
        ),
        (
            "places:\n  a: [0, 0]\n  b: [2e5, 1]\ndo: [{goto: a}]",
            "m:3: places.b[0]: expected -100000 to 100000 [m], got 200000",
        ),
        ("do:\n- wait: 1\n  goto: [1, 2]", "m:2: do[0].wait: this step is"),
        ("do:\n- {}", "m:2: do[0]: an empty step; expected one of goto, "),
        (
            "do:\n- wait: 1\n- explore:",
            "m:3: do[1].explore: expected a mapping, got nothing; write `explore: {}`",
        ),
        ("do:\n- hand_over: ~", "do[0].hand_over: expected a list of 3 or a mapping, got ~; write"),
        (
            "do:\n- wait: 1\n- explore:\n  wait: 5",
            "m:3: 'explore' has no value, and this step is 'wait' already; split it into two steps",
        ),
        (
            "trees: {a: [{retry: {times: 2, do: [{goto: [1, 2], visit: }]}}]}\ndo: [{tree: a}]",
            "m:1: 'visit' has no value, and this step is 'goto' already; split it into two steps",
        ),
        ("do:\n- goto:", "m:2: do[0].goto: expected a string of length <= 64 or a list of length"),
        ("do:\n- timeout:", "m:2: do[0].timeout: expected a mapping, got nothing"),
        (
            "do:\n- wait: 1\n- explore",
            "m:3: do[1]: expected a mapping, got 'explore'; write `explore: {}`",
        ),
        ("do: [goto]", "m:1: do[0]: expected a mapping, got 'goto'; write `goto: ...`"),
        ("do: [dance]", "m:1: do[0]: expected a mapping, got 'dance'"),
        (
            "do:\n- goto: {x: 1, y: 2}",
            "m:2: unknown field 'x'; known: tag; without fields: a string or a list",
        ),
        (
            "do:\n- battery_below: {percentage: 9, goto: {x: 1}, do: [{wait: 1}]}",
            "m:2: unknown field 'x'; known: tag; without fields: a string or a list",
        ),
        ("do:\n- tree: b", "m:2: do[0].tree: no tree 'b'; known: none"),
        (
            "trees:\n  a: [{tree: b}]\n  b: [{retry: {times: 2, do: [{tree: a}]}}]\n"
            "do: [{tree: a}]",
            "m:2: trees.a: is a cycle: a → b → a; remove a step",
        ),
        (
            "trees:\n  a: [{tree: a}]\ndo: [{wait: 1}]",
            "m:2: trees.a: is a cycle: a → a; remove a step",
        ),
        ("do:\n- check: nonsense", "m:2: do[0].check: expected a field, one of < <= > >= == != "),
        (
            "do:\n- wait_until: battery.percentag < 3",
            "m:2: do[0].wait_until: no field 'percentag'; did you mean 'percentage'?",
        ),
        ("do:\n- check: pose.x == here", "pose.x is a number; it cannot be compared with 'here'"),
        ("do:\n- check: gate.mode < idle", "gate.mode is a word; expected == or !=, got <"),
        ("do:\n- check: pose.x < nan", "pose.x is a number; it cannot be compared with 'nan'"),
        ("do:\n- check: robot.legs < 4", "no field 'robot'"),
        (
            "do:\n- wait_until: gate.mode == enabeld",
            "m:2: do[0].wait_until: gate.mode: no word 'enabeld'; did you mean 'enabled'? "
            "known: enabled, idle, latched, stopping",
        ),
        ("do:\n- check: task.current.state != runing", "task.current.state: no word 'runing'"),
        (
            "do:\n- check: imu.orientation.7 < 1",
            "m:2: do[0].check: imu.orientation.7: no index 7; expected 0 to 3",
        ),
        ("do:\n- check: joints.128.position > 1", "no index 128; expected 0 to 127"),
        ("do:\n- check: map.cells == 3", "map.cells is not a number, word or boolean"),
        (
            f"do:\n- check: joints.{'9' * 5000}.position > 1",
            "m:2: do[0].check: expected a string of length <= 200",
        ),
        (
            "do:\n- battery_below: {percentage: 50, goto: [0, 0], until: 20, do: [{wait: 1}]}",
            "m:2: do[0].battery_below.until: expected at least the percentage 50, got",
        ),
        ("do:\n- explore: {speed: 1}", "m:2: unknown field 'speed'; known: none"),
        ("", "m:1: the file is empty"),
    ],
)
def test_an_invalid_mission_is_refused_with_its_line(text: str, problem: str) -> None:
    with pytest.raises(ConfigError) as refused:
        mission_files.loads(text, "m")
    assert problem in str(refused.value)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("points:\n- [2e5, 1]", "round.yaml:2: points[0][0]: expected -100000 to 100000 [m]"),
        ("places: {a: [1, 2e5]}\npoints: [a]", "round.yaml:1: places.a[1]: expected -100000 to"),
    ],
)
def test_a_patrol_beyond_all_maps_is_refused_with_its_line(
    tmp_path: Path, text: str, problem: str
) -> None:
    file = tmp_path / "round.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as refused:
        mission_files.load_patrol(file)
    assert problem in str(refused.value)


def test_a_goal_may_be_anywhere_that_a_message_can_hold() -> None:
    goal = Goal(x=1e5, y=-1e5, yaw=-1e6)
    mission = mission_files.loads(missions.text_of(missions.goal_mission(goal)), "m")
    assert mission == missions.goal_mission(goal)


def test_a_field_with_the_value_null_is_ignored() -> None:
    mission = mission_files.loads('{"do": [{"goto": [1, 2], "explore": null}]}', "m")
    assert missions.text_of(mission) == '{"do":[{"goto":[1.0,2.0]}]}'


def test_trees_with_too_many_steps_when_expanded_are_refused() -> None:
    trees = "".join(f"  t{i}: [{{tree: t{i + 1}}}, {{tree: t{i + 1}}}]\n" for i in range(30))
    text = f"trees:\n{trees}  t30: [{{wait: 1}}]\ndo: [{{tree: t0}}]"
    with pytest.raises(ConfigError, match="more than 2000 steps once every tree is written out"):
        mission_files.loads(text, "m")


@pytest.mark.long
@pytest.mark.parametrize("order", [1, -1])
def test_trees_that_are_too_deep_when_expanded_are_refused(order: int) -> None:
    def chain(count: int) -> str:
        inner = [f"  t{i}: [{{tree: t{i + 1}}}]\n" for i in range(count)][::order]
        return f"trees:\n{''.join(inner)}  t{count}: [{{wait: 1}}]\ndo: [{{tree: t0}}]"

    assert mission_files.loads(chain(48), "m").drives is False
    for count in (49, 1900):
        with pytest.raises(ConfigError, match="more than 50 nested steps"):
            mission_files.loads(chain(count), "m")


def test_a_mission_lists_its_programs_and_undefined_places(tmp_path: Path) -> None:
    file = tmp_path / "m.yaml"
    file.write_text("do: [{script: {run: beep}}, {wait: 3}]")
    mission, text = mission_files.load(file)
    assert list(mission.scripts) == ["beep"]
    assert not mission.drives
    assert text == file.read_text()
    file.write_text(f"# {'x' * 60_000}\ndo: [{{wait: 3}}]")
    with pytest.raises(ConfigError, match=r"m\.yaml: 60018 bytes; expected at most 60000"):
        mission_files.load(file)
    file.write_text("do: [{goto: b}, {patrol: {points: [a, c]}}]\nplaces: {a: [1, 2]}")
    places = missions.map_places(mission_files.load(file)[0])
    assert sorted(places) == ["b", "c"]  # the map may define them
    with pytest.raises(ConfigError, match=r"x:1: do\[0\].goto: no place 'b'"):
        mission_files.loads(file.read_text(), "x", [Place(name="c", x=1.0, y=0.0)])
