"""Alpha's way to walk, and what its firmware takes as a gait at all."""

import math

from gigabrain_drivers.kinematics import Gait, Walker

# Quick and short steps: while two feet bear the body it tips over them, the less the sooner they
# change. At 2.5 Hz the body's speed swings by 0.036 m/s rms at 0.3 m/s, at 3.6 Hz by half of that.
WALKER = Walker(frequency=3.6, max_frequency=4.2, duty=0.6)

FREQUENCY = (1.0, 5.0)  # [Hz]
DUTY = (0.5, 0.9)
HEIGHT = (0.20, 0.33)  # [m]
MOST_STRIDE = 0.25  # [m], ahead or sideways, in one cycle
MOST_TURN = 0.6  # [rad] in one cycle


def sound(gait: Gait) -> bool:
    """Whether these are numbers, and within what the legs can do."""
    values = (gait.stride_x, gait.stride_y, gait.turn, gait.frequency, gait.duty, gait.height)
    if not all(map(math.isfinite, (*values, *gait.phases))):
        return False
    return (
        math.hypot(gait.stride_x, gait.stride_y) <= MOST_STRIDE
        and abs(gait.turn) <= MOST_TURN
        and FREQUENCY[0] <= gait.frequency <= FREQUENCY[1]
        and DUTY[0] <= gait.duty <= DUTY[1]
        and HEIGHT[0] <= gait.height <= HEIGHT[1]
        and all(0.0 <= phase < 1.0 for phase in gait.phases)
    )
