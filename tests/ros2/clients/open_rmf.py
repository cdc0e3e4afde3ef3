"""Open-RMF's side of a robot: reads and requests the same as the adapter free_fleet.

It uses the adapter's libraries, and follows open-rmf/free_fleet at 002505f. Start it by
`python open_rmf.py ROBOT CONFIG` with a Zenoh configuration. Each line of JSON on stdin is a call,
such as `["navigate", 1, 0]`, and one line of JSON on stdout answers it.
"""

import json
import math
import os
import sys
from dataclasses import dataclass

import zenoh
from pycdr2 import IdlStruct
from pycdr2.types import array, float32, float64, int8, int16, int32, sequence, uint8, uint32

TIMEOUT_S = 30.0
Id = array[uint8, 16]


@dataclass
class Time(IdlStruct):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct):
    stamp: Time
    frame_id: str


@dataclass
class Vector(IdlStruct):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct):
    position: Vector
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct):
    header: Header
    pose: Pose


@dataclass
class SendGoalRequest(IdlStruct):
    goal_id: Id
    pose: PoseStamped
    behavior_tree: str


@dataclass
class SendGoalResponse(IdlStruct):
    accepted: bool
    stamp: Time


@dataclass
class GetResultRequest(IdlStruct):
    goal_id: Id


@dataclass
class GetResultResponse(IdlStruct):
    status: int8  # the following fields are not read


@dataclass
class Feedback(IdlStruct):
    goal_id: Id
    current_pose: PoseStamped
    navigation_time: Time
    estimated_time_remaining: Time
    number_of_recoveries: int16
    distance_remaining: float32


@dataclass
class GoalInfo(IdlStruct):
    goal_id: Id
    stamp: Time


@dataclass
class CancelResponse(IdlStruct):
    return_code: int8
    goals_canceling: sequence[GoalInfo]


@dataclass
class Transform(IdlStruct):
    header: Header
    child_frame_id: str
    translation: Vector
    rotation: Quaternion


@dataclass
class Transforms(IdlStruct):
    transforms: sequence[Transform]


@dataclass
class BatteryState(IdlStruct):
    header: Header
    voltage: float32
    temperature: float32
    current: float32
    charge: float32
    capacity: float32
    design_capacity: float32
    percentage: float32
    power_supply_status: uint8
    power_supply_health: uint8
    power_supply_technology: uint8
    present: bool
    cell_voltage: sequence[float32]
    cell_temperature: sequence[float32]
    location: str
    serial_number: str


class Adapter:
    """Keeps frames, battery and feedback of one robot, and sends requests to it."""

    def __init__(self, session: zenoh.Session, robot: str) -> None:
        self.session, self.robot = session, robot
        self.frames: dict[str, Transform] = {}
        self.charge: float | None = None
        self.received_feedback: list[Feedback] = []
        self.goal_id: list[int] | None = None
        action = "navigate_to_pose/_action"
        self.subscribers = [
            session.declare_subscriber(f"{robot}/{key}", lambda sample, take=take: take(
                sample.payload.to_bytes()))
            for key, take in (
                ("tf", self.on_tf),
                ("battery_state", self.on_battery),
                (f"{action}/feedback", self.on_feedback),
            )
        ]  # fmt: skip

    def on_tf(self, data: bytes) -> None:
        for each in Transforms.deserialize(data).transforms:
            self.frames[each.child_frame_id] = each

    def on_feedback(self, data: bytes) -> None:
        self.received_feedback.append(Feedback.deserialize(data))

    def on_battery(self, data: bytes) -> None:
        self.charge = BatteryState.deserialize(data).percentage

    def ask(self, name: str, request: bytes) -> tuple[bytes | None, str]:
        """Return the response, or the text of an error."""
        key = f"{self.robot}/navigate_to_pose/_action/{name}"
        for reply in self.session.get(key, payload=request, timeout=TIMEOUT_S):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes(), ""
            return None, reply.err.payload.to_bytes().decode()
        return None, "no answer"

    def pose(self) -> list[float] | None:
        """Return x, y and yaw of base_footprint in the map; None while frames are missing."""
        x = y = yaw = 0.0
        frame = "base_footprint"
        while frame != "map":
            at = self.frames.get(frame)
            if at is None:
                return None
            turn = 2 * math.atan2(at.rotation.z, at.rotation.w)
            cos, sin = math.cos(turn), math.sin(turn)
            x, y = at.translation.x + cos * x - sin * y, at.translation.y + sin * x + cos * y
            yaw, frame = yaw + turn, at.header.frame_id
        return [x, y, math.remainder(yaw, 2 * math.pi)]

    def battery(self) -> float | None:
        """Return the state of charge, 0 to 1."""
        return self.charge

    def feedback(self) -> list[object] | None:
        """Return frame, remaining distance and time, and whether it is of the present goal."""
        if not self.received_feedback:
            return None
        last = self.received_feedback[-1]
        left = last.distance_remaining, last.estimated_time_remaining.sec
        return [last.current_pose.header.frame_id, *left, list(last.goal_id) == self.goal_id]

    def navigate(self, x: float, y: float) -> object:
        """Cancel the previous goal, and send a new one; return whether it is accepted."""
        if self.goal_id is not None:
            self.stop()
        self.goal_id = list(os.urandom(16))
        where = Pose(Vector(x, y, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
        goal = SendGoalRequest(self.goal_id, PoseStamped(Header(Time(0, 0), "map"), where), "")
        response, error = self.ask("send_goal", goal.serialize())
        return SendGoalResponse.deserialize(response).accepted if response else error

    def status(self) -> object:
        """Return the state of the present goal."""
        response, error = self.ask("get_result", GetResultRequest(self.goal_id).serialize())
        return GetResultResponse.deserialize(response).status if response else error

    def stop(self) -> object:
        """Cancel all goals; return the code of action_msgs/CancelGoal."""
        every = GoalInfo([0] * 16, Time(0, 0))
        response, error = self.ask("cancel_goal", every.serialize())
        return CancelResponse.deserialize(response).return_code if response else error

    def garbage(self, name: str, payload: str) -> str:
        """Send malformed bytes (hexadecimal); return the error text."""
        return self.ask(name, bytes.fromhex(payload))[1]


def main() -> None:
    """Answer calls until stdin ends."""
    robot, config = sys.argv[1:]
    with zenoh.open(zenoh.Config.from_file(config)) as session:
        adapter = Adapter(session, robot)
        for line in sys.stdin:
            name, *given = json.loads(line)
            print(json.dumps(getattr(adapter, name)(*given)), flush=True)


if __name__ == "__main__":
    main()
