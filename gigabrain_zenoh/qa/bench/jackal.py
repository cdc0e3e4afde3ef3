"""The BARN bench's Jackal in MuJoCo: four wheels that skid in every turn, among solid posts.

It replaces `KinematicJackal`, with the same delay, lag, and errors of odometry and lidar. Slip and
acceleration follow from the physics.
"""

import math
from importlib.resources import files

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.body import SimLidar, SimModel
from gigabrain_drivers.sim.scene import ROBOT, compile_scene
from gigabrain_drivers.sim.sensors import Lidar
from gigabrain_drivers.sim.world import Cylinder, World
from gigabrain_drivers.sim.world import Pose as Place
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Lidar as LidarDescription
from gigabrain_zenoh.qa.bench.barn_course import FIELD_OF_VIEW_RAD, Conditions, JackalBody

PHYSICS_STEPS = 4  # per 10 ms, two for each new motor command
WHEEL_RADIUS_M, TRACK_M = 0.098, 0.37559  # [m]
TRACK_FACTOR = 1.5  # from the maker: skidding wheels turn farther than rolling ones
POST_HEIGHT_M, WALLS_M = 1.0, 50.0  # height of posts, and distance of the outer walls
LEFT = (f"{ROBOT}front_left", f"{ROBOT}rear_left")
RIGHT = (f"{ROBOT}front_right", f"{ROBOT}rear_right")


class MujocoJackal(JackalBody):
    """The body of one trial, with MuJoCo's physics."""

    def __init__(
        self, conditions: Conditions, start: tuple[float, float, float], posts: Floats, seed: int
    ) -> None:
        super().__init__(conditions, start, np.random.default_rng(seed))
        model = (files("gigabrain_drivers") / "sim" / "jackal.xml").read_text(encoding="utf-8")
        body = SimModel(model=model, substeps=PHYSICS_STEPS)
        self._model = compile_scene(body, _world(start, posts))
        self._data = mujoco.MjData(self._model)
        self._left = [self._model.actuator(name).id for name in LEFT]
        self._right = [self._model.actuator(name).id for name in RIGHT]
        names = (*LEFT, *RIGHT)
        self._wheels = [int(self._model.joint(f"{name}_joint").dofadr[0]) for name in names]
        self._place = int(self._model.joint(f"{ROBOT}free").qposadr[0])
        self._gyro = int(self._model.sensor(f"{ROBOT}gyro").adr[0]) + 2
        self._lidar: Lidar | None = None
        self._target = (0.0, 0.0)  # motors' target: forward [m/s], turning [rad/s]
        mujoco.mj_forward(self._model, self._data)

    @property
    def velocity(self) -> Velocity:
        """The velocity, as measured by wheels and gyro."""
        v = WHEEL_RADIUS_M * float(self._data.qvel[self._wheels].mean())
        w = float(self._data.sensordata[self._gyro])
        return Velocity(linear_x=v * self._linear_scale, angular_z=w * self._angular_scale)

    def tick(self, command: Velocity) -> None:
        """Drive for 20 ms with `command`."""
        super().tick(command)
        x, y, _, a, b, c, d = self._data.qpos[self._place : self._place + 7].tolist()
        self.x, self.y = x, y
        self.yaw = math.atan2(2 * (a * d + b * c), 1 - 2 * (c * c + d * d))

    def _substep(self, command: Velocity, dt: float) -> None:
        share = self._lag_share(dt)
        v, w = self._target
        v, w = v + share * (command.linear_x - v), w + share * (command.angular_z - w)
        self._target = v, w
        across = w * TRACK_FACTOR * TRACK_M / 2
        self._data.ctrl[self._left] = (v - across) / WHEEL_RADIUS_M
        self._data.ctrl[self._right] = (v + across) / WHEEL_RADIUS_M
        mujoco.mj_step(self._model, self._data, nstep=round(dt / self._model.opt.timestep))
        before, measured = self.odometry, self.velocity
        middle = before.yaw + 0.5 * measured.angular_z * dt
        self.odometry = Pose(
            x=before.x + measured.linear_x * math.cos(middle) * dt,
            y=before.y + measured.linear_x * math.sin(middle) * dt,
            yaw=math.remainder(before.yaw + measured.angular_z * dt, math.tau),
        )

    def scan(self, lidar: LidarDescription, _discs: Floats) -> NDArray[np.float32]:
        """Return a scan among the posts: (beams,) [m], inf where nothing is hit."""
        if self._lidar is None:
            config = SimLidar(
                beams=lidar.beams,
                range_min=lidar.range_min,
                range_max=lidar.range_max,
                noise_m=self._conditions.noise,
            )
            self._lidar = Lidar(config, self._model, f"{ROBOT}lidar", self._random)
        angles = np.linspace(-FIELD_OF_VIEW_RAD / 2, FIELD_OF_VIEW_RAD / 2, lidar.beams)
        directions = np.stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)), axis=1)
        ranges = self._lidar.cast(self._data, directions)
        ranges[self._random.random(lidar.beams) < self._conditions.dropouts] = np.inf
        return ranges


def _world(start: tuple[float, float, float], posts: Floats) -> World:
    return World(
        name="barn",
        description="posts",
        half_x=WALLS_M,
        half_y=WALLS_M,
        shapes=tuple(Cylinder(x, y, radius, POST_HEIGHT_M) for x, y, radius in posts.tolist()),
        start=Place(*start),
    )
