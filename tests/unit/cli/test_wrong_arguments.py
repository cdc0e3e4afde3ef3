"""Commands refuse wrong arguments before they connect: here no robot runs."""

import shlex
from pathlib import Path

import pytest

from gigabrain_zenoh.cli.app import _call
from tests.places import ROOT

LONG = 65 * "x"
BAG = ROOT / "tests/recordings/arena.mcap"
LINES = [
    ("goto nan 1", "a goal takes numbers up to 100000, got nan 1"),
    ("goto 1 2e5", "a goal takes numbers up to 100000, got 1 200000"),
    (f"goto {LONG}", "a place has a name of 1 to 64 characters"),
    (f"goto --object {LONG}", "a thing has a class of 1 to 64 characters"),
    ("goto --tag -1", "a tag has a number from 0 to 1000000, got -1"),
    ("mission missing.yaml", "missing.yaml: no such file"),
    ("patrol missing.yaml", "missing.yaml: no such file"),
    ("pick ''", "pick: expected a class of at most 64 characters"),
    *(
        (f"task {do} {LONG}", "a task has a name of at most 64 characters")
        for do in ("cancel", "pause", "resume")
    ),
    ("world add box 1e9 0", "X: expected a number >= -100000.0 and <= 100000.0, got 1000000000.0"),
    ("world add box 0 0 --size 0 1 1", "--size: expected a number >= 0.02"),
    ("world add person 0 0 --to 1e9 0", "--to: expected a number <= 100000.0"),
    ("world remove ''", "NAME: expected a name of 1 to 32 characters, got ''"),
    ("map save office.yaml", "NAME: expected a string of length <= 64 and of letters"),
    ("map load ../office", "NAME: expected a string of length <= 64 and of letters"),
    ("place add kitchen/1", "NAME: expected a string of length <= 64 and of letters"),
    ("place add kitchen 1e9 0", "X: expected a number >= -100000.0 and <= 100000.0"),
    ("place add kitchen 0 0 1e9", "YAW: expected a number >= "),
    ("place remove ''", "NAME: expected a name of 1 to 64 characters, got ''"),
    ("zone add lab keepout 0 0 1 0", "zone 'lab': a polygon has at least 3 points"),
    ("zone add lab keepout 0 0 1 0 1e9 1", "POINTS: expected a number <= 100000.0"),
    ("zone add lab one_way 0 0 1 0 --width 1e9", "--width: expected a number >= 0.05 and <= 100.0"),
    ("arm jog '' 10", "JOINT: expected a name of 1 to 64 characters, got ''"),
    ("arm goto 1e9 0 0", "gigabrain: arm: reach.at[0]: expected a number >= -10.0 and <= 10.0"),
    ("objects --forget -1", "--forget: expected a whole number >= 0"),
    ("objects --forget-tag 9999999", "--forget-tag: expected a whole number <= 1000000"),
    ("objects --forget 1 --forget-all", "choose --forget-all, or --forget and --forget-tag"),
    ("pose 1e9 0", "X: expected a number >= -100000.0 and <= 100000.0, got 1000000000.0"),
    ("pose 0 0 1e9", "YAW: expected a number >= "),
    ("node info ''", "PROCESS: expected a name of 1 to 64 characters, got ''"),
    ("param get '' max_linear_speed", "PROCESS: expected a name of 1 to 64 characters, got ''"),
    ("param get decision ''", "NAME: expected a name of 1 to 64 characters, got ''"),
    (f"param set decision {LONG} 1", "NAME: expected a name of 1 to 64 characters, got 'xxx"),
    (f"param set decision speed {8 * LONG}", "VALUE: expected a string of length <= 500, got xx"),
    ("param set decision speed 1 --save .", "cannot write .: "),
    ("param save comment.yaml", "comment.yaml:1: has a comment, which would be lost"),
    ("topic echo ''", "no topic ''; known: "),
    ("topic echo estop", "estop is a service, not a topic; use: gigabrain estop"),
    ("topic hz 'a//b'", "no topic 'a//b'; "),
    ("topic bw 'robot//*'", "expected a key expression, got 'robot//*'"),
    ("topic delay scan#", "no topic 'scan#'; did you mean 'scan'?"),
    ("topic info goal", "goal is a service, not a topic; use: gigabrain goto"),
    ("topic pub scam x=1", "no topic 'scam'; did you mean 'scan'?"),
    ("topic pub cmd_vel linear_x=a", "CmdVel: linear_x: expected a number, got a string"),
    ("record --topics scam", "no topic 'scam'; did you mean 'scan'?"),
    ("record -o comment.yaml", "comment.yaml exists; choose another file"),
    ("record -o comment.yaml/drive.mcap", "comment.yaml is not a folder"),
    (f"bag play {BAG} --topics scam", "no topic 'scam'; did you mean 'scan'?"),
    ("bag play missing.mcap", "cannot read missing.mcap: "),
    ("driver run mock --world hose", "no world 'hose'; did you mean 'house'?"),
    ("decision --behaviour avod", "no behaviour 'avod'; did you mean 'avoid'?"),
    ("node run driverr", "no process 'driverr'; did you mean 'driver'?"),
    ("ros2 --domain 300", "--domain: expected a whole number >= 0 and <= 232, got 300"),
    ("ros2 --types missing", "missing"),
    ("ros2 topics --types missing", "missing"),
    ("ros2 pass robot/scan scan std_msgs/String", "expected a ROS topic, which starts with /"),
    ("page --port 99999", "--port: expected a whole number >= 0 and <= 65535, got 99999"),
    ("foxglove --port 99999", "--port: expected a whole number >= 0 and <= 65535, got 99999"),
    ("view --picture comment.yaml", "cannot write comment.yaml: it would be a PNG"),
    ("graph --png comment.yaml", "cannot write comment.yaml: it would be a PNG"),
    ("log --level loud", "no log level 'loud'; known: "),
    ("audit --newest 0", "--newest: expected 1 to 1000, got 0"),
    ("config --set seed=1", "--set and --settings need a deployment file"),
    ("why --keys missing", "missing: no folder with keys"),
    ("render x.png --seed -1", "--seed: expected a whole number >= 0 and <= 4294967296, got -1"),
    *(
        (f"{command} --seed -1", "--seed: expected a whole number >= 0 and <= 4294967296, got -1")
        for command in (
            "bench plan",
            "bench eyes",
            "bench reach so101",
            "bench slam",
            "emulate so101",
        )
    ),
    ("proxy tcp/127.0.0.1:1 --seed -1", "--seed: expected a whole number >= 0"),
    ("proxy /dev/ttyS9 --baud -1", "--baud: expected a number above 0, got -1"),
    ("proxy tcp/127.0.0.1:1 --chaos delay_ms=-1", "delay_ms: expected a number >= 0.0"),
    ("bench goals --hours -1", "--hours: expected a number above 0, got -1"),
    ("faults --repeat 0", "--repeat: expected a number above 0, got 0"),
    *(
        (f"{command}\udcff", "\\udcff': expected UTF-8 text")
        for command in (
            "keys new ",
            "pick ",
            "config demo --set seed=",
            "router --namespace ",
            "topic pub cmd_vel linear_x=",
        )
    ),
]


@pytest.mark.parametrize(("line", "error"), LINES)
def test_a_wrong_argument_is_named_where_no_robot_runs(
    line: str,
    error: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "no robots"))
    (tmp_path / "comment.yaml").write_text("# slow\nseed: 1\n")
    code, shown = _call(shlex.split(line)), capsys.readouterr().err
    assert code == 2, shown
    assert shown.startswith("gigabrain: ")
    assert error in shown
    assert shown.count("\n") == 1
