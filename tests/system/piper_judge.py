"""The vendor's SDK of the Piper on a CAN bus, in an environment of its own.

`python piper_judge.py drive GROUP` drives the arm on a bus; `listen GROUP SECONDS` shows what
others command on it; `kinematics` reads postures from standard input, and prints tools' poses.
The bus's port comes by python-can's own variable CAN_CONFIG. Prints one line of JSON.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

from piper_sdk import C_PiperForwardKinematics, C_PiperInterface_V2

PATIENCE_S = 20.0
MILLI = 57295.7795  # thousandths of a degree in a radian


def connect(group: str) -> Any:
    """Connect the SDK to a bus by UDP multicast, by its own options."""
    arm = C_PiperInterface_V2("can0", judge_flag=False, can_auto_init=False)
    arm.CreateCanBus(group, bustype="udp_multicast", judge_flag=False)
    arm.ConnectPort()
    return arm


def until(condition: Callable[[], bool], act: Callable[[], object] = lambda: None) -> bool:
    """Act until a condition holds; return whether it ever did."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if condition():
            return True
        act()
        time.sleep(0.01)
    return False


def joints(arm: Any) -> list[float]:
    """Return what the SDK has of the six joints [rad]."""
    state = arm.GetArmJointMsgs().joint_state
    return [getattr(state, f"joint_{number}") / MILLI for number in range(1, 7)]


def near(arm: Any, wanted: list[float]) -> bool:
    """Return whether the arm is where it should be."""
    return all(abs(a - b) < 0.01 for a, b in zip(joints(arm), wanted, strict=True))


def drive(group: str) -> dict[str, Any]:
    """Drive as the vendor's examples do."""
    arm = connect(group)
    told: dict[str, Any] = {"reports": until(lambda: any(joints(arm)))}
    told["first"] = joints(arm)
    told["enabled"] = until(arm.EnablePiper)
    goal = [0.2, 0.8, -1.0, 0.3, 0.5, -0.2]

    def aim() -> None:
        arm.MotionCtrl_2(0x01, 0x01, 100, 0x00)
        arm.JointCtrl(*(round(angle * MILLI) for angle in goal))
        arm.GripperCtrl(40_000, 1000, 0x01, 0)

    told["reached"] = until(lambda: near(arm, goal), aim)
    told["gripper"] = until(lambda: abs(arm.GetArmGripperMsgs().gripper_state.grippers_angle
                                        - 40_000) < 500, aim)  # fmt: skip
    status = arm.GetArmStatus().arm_status
    told["status"] = [int(status.ctrl_mode), int(status.arm_status), int(status.mode_feed)]
    slow = arm.GetArmLowSpdInfoMsgs().motor_2
    told["volts"], told["celsius"] = slow.vol * 0.1, slow.motor_temp
    told["on"] = arm.GetArmEnableStatus()
    # of one motor: the SDK keeps the newest answer for all
    told["limits"] = until(
        lambda: arm.GetAllMotorAngleLimitMaxSpd().all_motor_angle_limit_max_spd.motor[2]
        .max_angle_limit == 1799, lambda: arm.SearchMotorMaxAngleSpdAccLimit(2, 1))  # fmt: skip
    told["firmware"] = until(
        lambda: arm.GetPiperFirmwareVersion() == "S-V1.8-1", arm.SearchPiperFirmwareVersion
    )
    goal[0] = 0.4

    def push() -> None:
        arm.MotionCtrl_2(0x01, 0x04, 0, 0xAD)
        arm.JointMitCtrl(1, goal[0], 0.0, 10.0, 2.0, 0.0)

    told["by torque"] = until(lambda: abs(joints(arm)[0] - goal[0]) < 0.02, push)
    arm.JointCtrl(0, round(4.0 * MILLI), 0, 0, 0, 0)  # beyond joint 2
    told["beyond"] = until(lambda: arm.GetArmStatus().arm_status.err_status.joint_2_angle_limit)
    arm.EmergencyStop(0x01)
    told["stopped"] = until(lambda: int(arm.GetArmStatus().arm_status.arm_status) == 1)
    arm.EmergencyStop(0x02)
    told["off"] = until(lambda: not any(arm.GetArmEnableStatus()))
    told["on again"] = until(arm.EnablePiper)
    return told


def listen(group: str, seconds: float) -> dict[str, Any]:
    """Show what another program commands."""
    arm = connect(group)
    print("listening", flush=True)
    time.sleep(seconds)
    wanted = arm.GetArmJointCtrl().joint_ctrl
    gripper = arm.GetArmGripperCtrl().gripper_ctrl
    mode = arm.GetArmCtrlCode151().ctrl_151
    return {
        "joints": [getattr(wanted, f"joint_{number}") / MILLI for number in range(1, 7)],
        "gripper": [gripper.grippers_angle, gripper.grippers_effort, gripper.status_code],
        "mode": [mode.ctrl_mode, mode.move_mode, mode.move_spd_rate_ctrl, mode.mit_mode],
        "measured": joints(arm),
    }


def kinematics() -> list[list[float]]:
    """Return x, y, z [mm], roll, pitch, yaw [deg] of the last link in postures [rad]."""
    made = C_PiperForwardKinematics(0x01)
    return [made.CalFK(posture)[5] for posture in json.load(sys.stdin)]


COMMANDS: dict[str, Callable[..., Any]] = {
    "drive": drive,
    "listen": lambda group, seconds: listen(group, float(seconds)),
    "kinematics": kinematics,
}
print("JSON " + json.dumps(COMMANDS[sys.argv[1]](*sys.argv[2:]), default=float), flush=True)
