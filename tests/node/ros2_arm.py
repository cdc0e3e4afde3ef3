"""An arm in memory with the gateway: the driver with its gate, and a stand-in for safety."""

import asyncio
import uuid
from contextlib import AsyncExitStack

import numpy as np
from msgspec.structs import replace

from gigabrain_drivers.bodies.mock.driver import MockBody, MockOptions
from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.body import ArmModel, Joint
from gigabrain_schemas.brain import JointCommand
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.topics import JOINT_CMD, SAFETY, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.client.requests import enable
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import DriverConfig
from gigabrain_zenoh.gateway.joint_requests import FOLLOW_TYPE, TRAJECTORY
from tests.node.ros2_robot import TICK_NS, TYPES, RosNode, gateway_on

POINT = "trajectory_msgs/msg/JointTrajectoryPoint"
NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


class MockArm(MockBody):
    """Joints that follow with a delay of 80 ms, as servos do, unless they are blocked."""

    def __init__(self, robot, options, run, mjcf=None):
        super().__init__(robot, options, run)
        self._mjcf = mjcf
        self.blocked, self.is_limp = False, False
        self.positions = self.targets = dict(zip(NAMES, robot.arm.home, strict=True))
        self.history = []  # the targets of each call

    async def set_joint_positions(self, positions):
        self.targets, self.is_limp = self.targets | dict(positions), False
        self.history.append(self.targets)
        return positions

    def arm_model(self):
        return ArmModel(mjcf=self._mjcf) if self._mjcf else super().arm_model()

    async def limp(self):
        self.is_limp = True

    async def read_state(self):
        before = self.positions
        if not (self.blocked or self.is_limp):
            self.positions = {
                name: at + 0.22 * (self.targets[name] - at) for name, at in before.items()
            }
        joints = tuple(
            Joint(name=name, position=at, velocity=(at - before[name]) / 0.02, effort=0.1)
            for name, at in self.positions.items()
        )
        return replace(await super().read_state(), joints=joints, limp=self.is_limp)


class FreezableNetwork:
    """A network for one process. While it is frozen, the process misses all messages."""

    def __init__(self, network):
        self._network, self.frozen = network, False

    def transport(self):
        transport = self._network.transport()
        subscribe = transport.subscribe
        transport.subscribe = lambda key, handle, depth, **lazy: subscribe(
            key, lambda *sample: self.frozen or handle(*sample), depth, **lazy
        )
        return transport


class ArmRobot:
    """A robot with only an arm: `async with ArmRobot(folder) as robot:`."""

    def __init__(self, folder, config=None, mjcf=None):
        self._folder, self._config, self._mjcf = folder, config, mjcf
        self.network, self.clock = LocalNetwork(), FakeClock()
        self.gateway_network = FreezableNetwork(self.network)
        self.state, self.safe = None, True

    async def __aenter__(self):
        self.robot = load_robot("so101")
        run = Run(folder=robot_path("so101").parent)
        self.arm = MockArm(self.robot, MockOptions(driver="mock"), run, self._mjcf)
        bus = Bus(self.network.transport(), self.clock, "driver")
        config = DriverConfig(body="so101", resume="manual", state_dir=str(self._folder))
        process = DriverProcess(config, self.robot, self.arm, bus)
        self._running = asyncio.ensure_future(process.run(lambda: None))
        self.operator = Bus(self.network.transport(), self.clock)
        self.operator.subscribe(STATE, self._on_state)
        self._stack = AsyncExitStack()
        self.gateway_bus, self.ros = await self._stack.enter_async_context(
            gateway_on(self.gateway_network, self.clock, self._config)
        )
        self.node = RosNode(self.ros, self.clock)
        await self.go(60)
        return self

    async def __aexit__(self, *_):
        await self._stack.aclose()
        self._running.cancel()
        await asyncio.gather(self._running, return_exceptions=True)

    def _on_state(self, _key, state):
        self.state = state
        if self.safe:
            self.operator.publish(SAFETY, SafetyState(verdict="ok"), basis=state.tick)

    async def released(self):
        assert (await self.node.call("/release", "std_srvs/srv/Trigger")).success
        await self.go(5)
        assert self.state.gate.mode == "idle"

    async def commanded(self):
        """Let control command the arm to hold its home position, as the brain would."""
        self.operator.subscribe(STATE, self._command_home)
        await self.go(50)
        await enable(self.operator, "control")
        await self.go(5)
        assert self.state.gate.commander == "control"

    def _command_home(self, _key, state):
        command = JointCommand(name=NAMES, position=self.robot.arm.home, source="control")
        self.operator.publish(JOINT_CMD, command, basis=state.tick)

    async def go(self, ticks):
        await self.clock.advance(ticks * TICK_NS)
        if self._running.done():
            self._running.result()

    def at(self, name):
        """Return the position of a joint."""
        return self.arm.positions[name]

    def diagnostics(self):
        """Return the newest diagnostic statuses by name."""
        found = self.node.received["/diagnostics"][-1].status
        return {each.name: each for each in found}

    def trajectory(self, *points, names=("shoulder_pan",), **fields):
        """Return a JointTrajectory; points are (seconds, positions...)."""
        messages = [
            TYPES.make(
                POINT, positions=np.array(positions, float),
                time_from_start={"sec": int(t), "nanosec": round(t % 1 * 1e9)},
            )
            for t, *positions in points
        ]  # fmt: skip
        return TYPES.make(TRAJECTORY, joint_names=list(names), points=messages, **fields)

    def publish(self, message):
        """Publish a trajectory on /joint_trajectory."""
        self.node.publish("/joint_trajectory", TRAJECTORY, header=message.header,
                          joint_names=message.joint_names, points=message.points)  # fmt: skip


class Client:
    """A client of the action /follow_joint_trajectory."""

    BASE = "/follow_joint_trajectory/_action"

    def __init__(self, robot):
        self._robot = robot
        robot.node.read(f"{self.BASE}/feedback", f"{FOLLOW_TYPE}_FeedbackMessage")

    @property
    def feedback(self):
        return [each.feedback for each in self._robot.node.received[f"{self.BASE}/feedback"]]

    async def send(self, message, **goal):
        """Send a goal; return its id."""
        id = uuid.uuid4().bytes
        goal_message = TYPES.make(f"{FOLLOW_TYPE}_Goal", trajectory=message, **goal)
        answer = await self._robot.node.call(
            f"{self.BASE}/send_goal",
            f"{FOLLOW_TYPE}_SendGoal",
            goal_id={"uuid": id},
            goal=goal_message,
        )
        assert answer.accepted
        return id

    async def cancel(self, id):
        info = {"goal_id": {"uuid": id}}
        service = f"{self.BASE}/cancel_goal"
        return await self._robot.node.call(service, "action_msgs/srv/CancelGoal", goal_info=info)

    async def result(self, id):
        """Return status, error code and text; call it after the end of the goal."""
        service = f"{self.BASE}/get_result"
        answer = await self._robot.node.call(service, f"{FOLLOW_TYPE}_GetResult",
                                             goal_id={"uuid": id})  # fmt: skip
        return answer.status, answer.result.error_code, answer.result.error_string
