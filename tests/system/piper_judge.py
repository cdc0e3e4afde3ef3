"""Use the vendor's SDK of the Piper on a CAN bus, in a separate environment.

`python piper_judge.py drive GROUP` drives the arm on a bus; `listen GROUP SECONDS` shows what
others command on it; `kinematics` reads postures from standard input, and prints tools' poses.
The port of the bus is in CAN_CONFIG, a variable of python-can. Prints one line of JSON.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

from piper_sdk import C_PiperForwardKinematics, C_PiperInterface_V2

PATIENCE_S = 20.0
MILLIDEGREES_PER_RAD = 57295.7795


def connect(group: str) -> Any:
    """Connect the SDK to a bus by UDP multicast, by its own options."""
    arm = C_PiperInterface_V2("can0", judge_flag=False, can_auto_init=False)
    arm.CreateCanBus(group, bustype="udp_multicast", judge_flag=False)
    arm.ConnectPort()
    return arm


def until(condition: Callable[[], bool], act: Callable[[], object] = lambda: None) -> bool:
    """Act until a condition holds; return whether it held within PATIENCE_S."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if condition():
            return True
        act()
        time.sleep(0.01)
    return False


def joints(arm: Any) -> list[float]:
    """Return the SDK's newest positions of the six joints [rad]."""
    state = arm.GetArmJointMsgs().joint_state
    return [getattr(state, f"joint_{number}") / MILLIDEGREES_PER_RAD for number in range(1, 7)]


def near(arm: Any, wanted: list[float]) -> bool:
    """Return whether all joints are within 0.01 rad of `wanted`."""
    return all(abs(a - b) < 0.01 for a, b in zip(joints(arm), wanted, strict=True))


def drive(group: str) -> dict[str, Any]:
    """Drive as the vendor's examples do; return the results of all steps."""
    arm = connect(group)
    results: dict[str, Any] = {"reports": until(lambda: any(joints(arm)))}
    results["first"] = joints(arm)
    results["enabled"] = until(arm.EnablePiper)
    goal = [0.2, 0.8, -1.0, 0.3, 0.5, -0.2]

    def aim() -> None:
        arm.MotionCtrl_2(0x01, 0x01, 100, 0x00)
        arm.JointCtrl(*(round(angle * MILLIDEGREES_PER_RAD) for angle in goal))
        arm.GripperCtrl(40_000, 1000, 0x01, 0)

    results["reached"] = until(lambda: near(arm, goal), aim)
    results["gripper"] = until(lambda: abs(arm.GetArmGripperMsgs().gripper_state.grippers_angle
                                        - 40_000) < 500, aim)  # fmt: skip
    status = arm.GetArmStatus().arm_status
    results["status"] = [int(status.ctrl_mode), int(status.arm_status), int(status.mode_feed)]
    slow = arm.GetArmLowSpdInfoMsgs().motor_2
    results["volts"], results["celsius"] = slow.vol * 0.1, slow.motor_temp
    results["on"] = arm.GetArmEnableStatus()
    # for one motor: the SDK keeps only the newest reply
    results["limits"] = until(
        lambda: arm.GetAllMotorAngleLimitMaxSpd().all_motor_angle_limit_max_spd.motor[2]
        .max_angle_limit == 1799, lambda: arm.SearchMotorMaxAngleSpdAccLimit(2, 1))  # fmt: skip
    results["firmware"] = until(
        lambda: arm.GetPiperFirmwareVersion() == "S-V1.8-1", arm.SearchPiperFirmwareVersion
    )
    goal[0] = 0.4

    def push() -> None:
        arm.MotionCtrl_2(0x01, 0x04, 0, 0xAD)
        arm.JointMitCtrl(1, goal[0], 0.0, 10.0, 2.0, 0.0)

    results["by torque"] = until(lambda: abs(joints(arm)[0] - goal[0]) < 0.02, push)
    arm.JointCtrl(0, round(4.0 * MILLIDEGREES_PER_RAD), 0, 0, 0, 0)  # beyond the limit of joint 2
    results["beyond"] = until(lambda: arm.GetArmStatus().arm_status.err_status.joint_2_angle_limit)
    arm.EmergencyStop(0x01)
    results["stopped"] = until(lambda: int(arm.GetArmStatus().arm_status.arm_status) == 1)
    arm.EmergencyStop(0x02)
    results["off"] = until(lambda: not any(arm.GetArmEnableStatus()))
    results["on again"] = until(arm.EnablePiper)
    return results


def listen(group: str, seconds: float) -> dict[str, Any]:
    """Return the commands of another program on the bus."""
    arm = connect(group)
    print("listening", flush=True)
    time.sleep(seconds)
    wanted = arm.GetArmJointCtrl().joint_ctrl
    gripper = arm.GetArmGripperCtrl().gripper_ctrl
    mode = arm.GetArmCtrlCode151().ctrl_151
    return {
        "joints": [
            getattr(wanted, f"joint_{number}") / MILLIDEGREES_PER_RAD for number in range(1, 7)
        ],
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
