"""Simulates a TurtleBot3 Burger: its controller board and lidar among walls, and its ROS node.

The node (`turtlebot3_node`) is a separate process, as on the robot's computer. The simulation
continues while the node is killed or frozen. As in the firmware, the board keeps the last command
until the heartbeat of the node is missing for 500 ms. `truth` returns the resulting pose.

Commands: `truth`, `place` (set the pose), `start_node`. Events: `node` with its pid, `node_ended`.
Settings: `walls` (segments [x1, y1, x2, y2] in metres), `start` [x, y, angle], `lidar` (`lds01` or
`lds02`), `stamped` (obeys TwistStamped), `hz` of the lidar, `noise_m` of its ranges, `seed`.
"""

import json
import math
import queue
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.ros2.programs.events import emit

TICK_S = 0.01
WHEEL_RADIUS_M, WHEEL_SEPARATION_M = 0.033, 0.160
BODY_RADIUS_M, RELEASE_M = 0.105, 0.005
MAX_SPEED_MPS, MAX_TURN_RADPS = 0.22, 2.84
ACCELERATION_MPS2, TURN_ACCELERATION_RADPS2 = 2.0, 15.0
HEARTBEAT_TIMEOUT_S = 0.5  # of the firmware
LIDAR_X_M = -0.032
PACKET_BYTES = 1 << 16
VOLTS = 12.0


@dataclass(frozen=True)
class Lidar:
    """The scan properties of one lidar model."""

    hz: float
    samples_per_s: float
    range_min_m: float
    range_max_m: float  # as published
    reach_m: float  # the real maximum range
    no_return: float  # the published range without a return


LIDARS = {
    "lds01": Lidar(5.0, 1800.0, 0.12, 3.5, 3.5, 0.0),
    "lds02": Lidar(10.0, 2300.0, 0.0, 100.0, 8.0, math.nan),
}


def cast(
    walls: np.ndarray, x_m: float, y_m: float, angles_rad: np.ndarray, reach_m: float
) -> np.ndarray:
    """Return the distances [m] (m,) to the first of the walls (n, 4) along angles (m,), or inf."""
    origins, spans = walls[:, :2] - (x_m, y_m), walls[:, 2:] - walls[:, :2]
    c, s = np.cos(angles_rad)[:, None], np.sin(angles_rad)[:, None]
    across = c * spans[:, 1] - s * spans[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (origins[:, 0] * spans[:, 1] - origins[:, 1] * spans[:, 0]) / across
        along = (origins[:, 0] * s - origins[:, 1] * c) / across
    hit = (distance >= 0) & (distance <= reach_m) & (along >= 0) & (along <= 1)
    return np.where(hit, distance, np.inf).min(axis=1, initial=np.inf)


def clearance(walls: np.ndarray, x_m: float, y_m: float) -> float:
    """Return the distance [m] from a point to the nearest wall."""
    spans = walls[:, 2:] - walls[:, :2]
    offsets = np.array((x_m, y_m)) - walls[:, :2]
    lengths = np.maximum((spans**2).sum(axis=1), 1e-12)
    along = np.clip((offsets * spans).sum(axis=1) / lengths, 0, 1)
    return float(np.hypot(*(offsets - along[:, None] * spans).T).min(initial=np.inf))


class Board:
    """The controller board with its wheels, in a world of walls."""

    def __init__(self, walls: np.ndarray, start: tuple[float, float, float]) -> None:
        self.walls = walls
        self.x_m, self.y_m, self.angle_rad = start
        self.speed_mps = self.turn_radps = 0.0
        self.wheels_rad = [0.0, 0.0]
        self.contacts = 0
        self.nearest_m = math.inf  # minimum distance of a wall to the body's centre, so far
        self.travelled_m = 0.0
        self._command = (0.0, 0.0)
        self._heartbeat_s = -math.inf
        self._touches = False

    def beat(self, now_s: float) -> None:
        """Receive a heartbeat of the node."""
        self._heartbeat_s = now_s

    def command(self, hundredths: tuple[int, int]) -> None:
        """Receive a command: speeds [0.01 m/s, 0.01 rad/s]."""
        speed, turn = (value / 100 for value in hundredths)
        self._command = (
            min(max(speed, -MAX_SPEED_MPS), MAX_SPEED_MPS),
            min(max(turn, -MAX_TURN_RADPS), MAX_TURN_RADPS),
        )

    def step(self, now_s: float, dt_s: float) -> None:
        """Advance the simulation by `dt_s`."""
        if now_s - self._heartbeat_s > HEARTBEAT_TIMEOUT_S:
            self._command = (0.0, 0.0)
        self.speed_mps = _toward(self.speed_mps, self._command[0], ACCELERATION_MPS2 * dt_s)
        self.turn_radps = _toward(
            self.turn_radps, self._command[1], TURN_ACCELERATION_RADPS2 * dt_s
        )
        half_mps = self.turn_radps * WHEEL_SEPARATION_M / 2
        for side, sign in enumerate((-1, 1)):
            rim_mps = self.speed_mps + sign * half_mps
            self.wheels_rad[side] += rim_mps * dt_s / WHEEL_RADIUS_M
        self._move(dt_s)

    def _move(self, dt_s: float) -> None:
        """Move the body, unless a wall blocks it; the wheels slip then."""
        middle_rad = self.angle_rad + self.turn_radps * dt_s / 2
        self.angle_rad = math.remainder(self.angle_rad + self.turn_radps * dt_s, math.tau)
        x_m = self.x_m + self.speed_mps * dt_s * math.cos(middle_rad)
        y_m = self.y_m + self.speed_mps * dt_s * math.sin(middle_rad)
        before_m, clearance_m = (
            clearance(self.walls, self.x_m, self.y_m),
            clearance(self.walls, x_m, y_m),
        )
        touches = clearance_m < BODY_RADIUS_M and clearance_m < before_m
        self.contacts += touches and not self._touches
        # a contact ends once the body has moved RELEASE_M away
        self._touches = touches or (self._touches and clearance_m < BODY_RADIUS_M + RELEASE_M)
        if not touches:
            self.travelled_m += abs(self.speed_mps) * dt_s
            self.x_m, self.y_m = x_m, y_m
        self.nearest_m = min(self.nearest_m, clearance_m)


def _toward(value: float, target: float, max_change: float) -> float:
    """Return `value` changed towards `target` by at most `max_change`."""
    return value + min(max(target - value, -max_change), max_change)


class Robot:
    """The board, the lidar and the process of the node, which a socket connects."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        walls = np.array(settings.get("walls", ()), dtype=float).reshape(-1, 4)
        self.board = Board(walls, tuple(settings.get("start", (0.0, 0.0, 0.0))))
        self._settings = settings
        self._lidar = LIDARS[settings.get("lidar", "lds02")]
        self._lidar_hz = float(settings.get("hz", self._lidar.hz))
        self._noise_m = float(settings.get("noise_m", 0.0))
        self._random = np.random.default_rng(settings.get("seed", 0))
        self._next_turn_s = 0.0
        self._node: subprocess.Popen[bytes] | None = None
        self._line: socket.socket | None = None

    def start_node(self) -> None:
        """Start the process of the node."""
        self.end_node()
        self._line, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._line.setblocking(False)
        words = json.dumps(dict(self._settings) | {"line": far.fileno(), "walls": []})
        command = [sys.executable, "-m", "tests.ros2.programs.turtlebot3_node", words]
        with far:
            self._node = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=sys.stderr, pass_fds=(far.fileno(),)
            )
        emit("node", pid=self._node.pid)

    def end_node(self) -> None:
        """Kill the process of the node."""
        if self._node:
            self._node.kill()
            self._node.wait()
            self._node = None
        if self._line:
            self._line.close()
            self._line = None

    def step(self, now_s: float, dt_s: float) -> None:
        """Process messages of the node, advance the simulation, and send a scan when it is due."""
        self._process_messages(now_s)
        steps = max(1, round(dt_s / TICK_S))  # several after a delay of a busy machine
        for _ in range(steps):
            self.board.step(now_s, dt_s / steps)
        if now_s >= self._next_turn_s:
            self._next_turn_s = max(self._next_turn_s + 1 / self._lidar_hz, now_s)
            self._send({"scan": self._scan(), "taken_ns": time.time_ns()})

    def _process_messages(self, now_s: float) -> None:
        while self._line:
            try:
                packet = self._line.recv(PACKET_BYTES)
            except BlockingIOError:
                return
            except ConnectionResetError:
                packet = b""
            if not packet:
                emit("node_ended", code=self._node.wait() if self._node else None)
                self._node = None
                self._line.close()
                self._line = None
                return
            message = json.loads(packet)
            if "command" in message:
                self.board.command(message["command"])
            elif "heartbeat" in message:
                self.board.beat(now_s)
            else:
                self._send({"registers": self._registers()})

    def _send(self, message: Mapping[str, Any]) -> None:
        """Send to the node; a message to a frozen node is lost."""
        if self._line:
            try:
                self._line.send(json.dumps(message).encode())
            except (BlockingIOError, BrokenPipeError):
                return

    def _registers(self) -> dict[str, Any]:
        board = self.board
        half_mps = board.turn_radps * WHEEL_SEPARATION_M / 2
        return {
            "wheels_rad": board.wheels_rad,
            "rims_mps": [board.speed_mps - half_mps, board.speed_mps + half_mps],
            "angle_rad": board.angle_rad,
            "turn_radps": board.turn_radps,
            "volts": VOLTS,
        }

    def _scan(self) -> dict[str, Any]:
        """Return a scan of the lidar, counter-clockwise from straight ahead."""
        board, lidar = self.board, self._lidar
        count = round(lidar.samples_per_s / self._lidar_hz)
        angles_rad = np.arange(count) * (math.tau / count)
        x_m = board.x_m + LIDAR_X_M * math.cos(board.angle_rad)
        y_m = board.y_m + LIDAR_X_M * math.sin(board.angle_rad)
        ranges_m = cast(board.walls, x_m, y_m, angles_rad + board.angle_rad, lidar.reach_m)
        ranges_m += self._random.normal(0.0, self._noise_m, count) if self._noise_m else 0.0
        ranges_m[~np.isfinite(ranges_m)] = lidar.no_return
        return {
            "ranges": np.round(ranges_m, 3).tolist(),
            "angle_increment": math.tau / count,
            "scan_time": 1 / self._lidar_hz,
            "range_min": lidar.range_min_m,
            "range_max": lidar.range_max_m,
        }


def main() -> None:
    """Run until stdin ends."""
    robot = Robot(json.loads(sys.argv[1]))
    board = robot.board
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)
        lines.put(None)

    def obey(do: str, id: int, **fields: Any) -> None:
        if do == "place":
            board.x_m, board.y_m, board.angle_rad = fields["pose"]
        elif do == "start_node":
            robot.start_node()
        pose = [board.x_m, board.y_m, board.angle_rad]
        emit(
            do,
            id=id,
            pose=pose,
            speed_mps=board.speed_mps,
            turn_radps=board.turn_radps,
            contacts=board.contacts,
            nearest_m=board.nearest_m - BODY_RADIUS_M,
            travelled_m=board.travelled_m,
        )

    threading.Thread(target=read, daemon=True).start()
    robot.start_node()
    emit("ready")
    before_s = time.monotonic()
    try:
        while True:
            while not lines.empty():
                if (line := lines.get()) is None:
                    return
                obey(**json.loads(line))
            now_s = time.monotonic()
            robot.step(now_s, now_s - before_s)
            before_s = now_s
            time.sleep(TICK_S)
    finally:
        robot.end_node()


if __name__ == "__main__":
    main()
