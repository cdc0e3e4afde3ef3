"""One thing that is followed: a Kalman filter of constant velocity, and whether it moves at all.

Both axes have the same noise, so that one 2 x 2 covariance serves both.
"""

import math
from dataclasses import dataclass

from gigabrain_schemas.brain import Obstacle

ACCELERATION = 0.8  # [m/s2], standard deviation of what a walking person does from scan to scan
FIRST_SPEED = 1.0  # [m/s], standard deviation of a speed of which nothing is known
TURNS_S = 0.06  # since it was last seen it may have gone the other way, for so long at most
TURNED, TURNED_PARTLY = 10.0, 16.0  # squares of the deviations off that noise does not explain
MOST_OFF, SHIFT_M, FARTHEST_M = 4.0, 0.05, 0.5  # deviations, [m]: what shows in part is so near
RADIUS_SHARE = 0.25  # of a new radius in the filtered one
MOVING_M, MOVING_SPEED = 0.15, 0.15  # [m], [m/s]: a thing must go so far, so fast, to count
QUICK = 0.5  # [m/s]
SURE = 2.5  # standard deviations that a speed must be off zero
STANDING_SPEED, STANDING_S = 0.12, 0.6  # slower for so long, it stands


@dataclass
class Track:
    """Position and velocity in the frame of the odometry."""

    id: int
    x: float  # [m]
    y: float  # [m]
    radius: float  # [m]
    position_variance: float  # [m2]
    velocity_x: float = 0.0  # [m/s]
    velocity_y: float = 0.0  # [m/s]
    covariance: float = 0.0  # [m2/s], of position and velocity
    velocity_variance: float = FIRST_SPEED**2  # [m2/s2]
    seen: int = 1  # scans
    unseen_s: float = 0.0
    moving: bool = False
    partly: bool = False  # when it was first seen, only a part of it was
    standing_s: float = 0.0
    anchor_x: float = 0.0  # [m], where it last stood
    anchor_y: float = 0.0

    def predict(self, dt: float) -> None:
        """Let `dt` [s] pass."""
        self.x += dt * self.velocity_x
        self.y += dt * self.velocity_y
        q = ACCELERATION**2
        self.position_variance += dt * (
            2 * self.covariance + dt * self.velocity_variance + dt**3 * q / 4
        )
        self.covariance += dt * (self.velocity_variance + dt * dt * q / 2)
        self.velocity_variance += dt * dt * q
        self.unseen_s += dt

    def correct(
        self, x: float, y: float, radius: float, noise: float, *, most_off: float = math.inf
    ) -> None:
        """It was seen at (x, y) [m] with a deviation of `noise` [m].

        Where it is more than `most_off` from where it should be (squares of deviations), it has
        turned.
        """
        dx, dy = x - self.x, y - self.y
        off = (dx * dx + dy * dy) / (self.position_variance + noise * noise)
        if self.moving and off > most_off:
            self._turn()
        innovation = self.position_variance + noise * noise
        k, kv = self.position_variance / innovation, self.covariance / innovation
        self.x += k * dx
        self.y += k * dy
        self.velocity_x += kv * dx
        self.velocity_y += kv * dy
        self.velocity_variance -= kv * self.covariance
        self.covariance *= 1.0 - k
        self.position_variance *= 1.0 - k
        self.radius += RADIUS_SHARE * (radius - self.radius)
        self.seen += 1
        self._stand(self.unseen_s)
        self.unseen_s = 0.0

    def _turn(self) -> None:
        """It is not where it should be: since it was last seen it goes another way, or stands."""
        square = max(self.velocity_x**2 + self.velocity_y**2, FIRST_SPEED**2)
        self.velocity_variance += square
        self.covariance += self.unseen_s * square / 2
        self.position_variance += self.unseen_s**2 * square / 3

    def may_be_at(self, x: float, y: float, noise: float) -> bool:
        """Whether it can be what was seen at (x, y) [m], with a deviation of `noise` [m]."""
        most = SHIFT_M + MOST_OFF * math.sqrt(self.position_variance + noise * noise)
        return math.hypot(x - self.x, y - self.y) < min(FARTHEST_M, most)

    def covers(self, place: tuple[float, float]) -> bool:
        """Whether a place [m] is within it."""
        return math.hypot(place[0] - self.x, place[1] - self.y) < self.radius

    @property
    def may_be_off(self) -> float:
        """How far it may be from where it should be, for it may have turned round [m]."""
        speed = math.hypot(self.velocity_x, self.velocity_y)
        return 2 * speed * min(self.unseen_s, TURNS_S) if self.moving else 0.0

    @property
    def moves_quickly(self) -> bool:
        """Whether it moves, and not at a stroll."""
        return self.moving and math.hypot(self.velocity_x, self.velocity_y) > QUICK

    def seems_to_move(self) -> bool:
        """Whether it has gone so far and so fast that it must be told whether it moves."""
        if self.moving or self.unseen_s > 0:
            return False
        speed = math.hypot(self.velocity_x, self.velocity_y)
        gone = math.hypot(self.x - self.anchor_x, self.y - self.anchor_y)
        sure = speed > SURE * math.sqrt(self.velocity_variance)
        return gone > MOVING_M and speed > MOVING_SPEED and sure

    def _stand(self, dt: float) -> None:
        """Notice when it has stopped."""
        speed = math.hypot(self.velocity_x, self.velocity_y)
        self.standing_s = self.standing_s + dt if speed < STANDING_SPEED else 0.0
        if self.moving and self.standing_s >= STANDING_S:
            self.moving, self.anchor_x, self.anchor_y = False, self.x, self.y

    def obstacle(self) -> Obstacle:
        """As the world shows it; what stands has no velocity."""
        p, c, v = self.position_variance, self.covariance, self.velocity_variance
        return Obstacle(
            id=self.id,
            x=self.x,
            y=self.y,
            velocity_x=self.velocity_x if self.moving else 0.0,
            velocity_y=self.velocity_y if self.moving else 0.0,
            radius=self.radius,
            covariance=(p, 0.0, c, 0.0, 0.0, p, 0.0, c, c, 0.0, v, 0.0, 0.0, c, 0.0, v),
        )
