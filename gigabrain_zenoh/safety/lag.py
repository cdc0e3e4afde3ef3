"""How late a body's measured speed follows what it was told, by cross-correlation.

This sees lateness of the line both ways, also one that was there from the start, but only while
speeds change: each delay of a grid predicts the measured speeds of the last 0.8 s from the told
ones with a gain and an offset of its own, and the one that leaves the least unexplained counts, if
it explains them well and the others do not.
"""

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.geometry.limits import ZERO

Floats = NDArray[np.float64]

LOOK_TICKS, LEAST_LOOK = 40, 20  # of measured speeds that are explained
DELAYS = 31  # candidates, a tick apart: 0 to 0.6 s
LEAST_DELAYS = 15  # while less has been told than the longest needs
SCALE = np.array([0.05, 0.05, 0.3])  # [m/s, m/s, rad/s], as following's tolerances
LEAST_CHANGE = 2.0  # of these, in the measured speeds: less is noise
UNEXPLAINED = 0.1  # share of the measured changes that the best delay may leave
WORSE = 4.0  # times as much is left by a delay that is refuted
EVERY_TICKS = 4  # the candidates are compared
SURE = 3  # comparisons in a row that say the same, until it is believed
REST_TICKS = 50  # without being told to move: then nothing is known any more

Speeds = tuple[float, float, float]


class Lag(msgspec.Struct, frozen=True, kw_only=True):
    """What is remembered of told and measured speeds, tick by tick."""

    told: tuple[Speeds, ...] = ()
    measured: tuple[Speeds, ...] = ()
    ticks: int | None = None  # how late it follows; None while that is not known
    guess: int = 0  # the newest delay that explains the speeds,
    guesses: int = 0  # and in how many comparisons in a row one like it did
    rest_ticks: int = 0


def look(before: Lag, state: RobotState, elapsed: int) -> Lag:
    """One state more, `elapsed` ticks after the last."""
    if not elapsed:
        return before
    told = (*before.told, *(_speeds(state.sent),) * elapsed)[-LOOK_TICKS - DELAYS + 1 :]
    rest = before.rest_ticks + elapsed if state.sent == ZERO else 0
    now = replace(before, told=told, rest_ticks=rest)
    if not state.link.connected:  # what comes after this may be later than what came before
        return replace(now, measured=())
    measured = (*before.measured, *(_speeds(state.velocity),) * elapsed)[-LOOK_TICKS:]
    now = replace(now, measured=measured)
    if rest > REST_TICKS:
        return replace(now, ticks=None, guesses=0)
    if state.tick // EVERY_TICKS == (state.tick - elapsed) // EVERY_TICKS:
        return now
    delay = _delay(now)
    if delay is None:
        return now
    guesses = now.guesses + 1 if abs(delay - now.guess) <= 1 else 1
    known = delay if guesses >= SURE else now.ticks
    return replace(now, guess=delay, guesses=guesses, ticks=known)


def _speeds(of: Velocity) -> Speeds:
    return of.linear_x, of.linear_y, of.angular_z


def _delay(now: Lag) -> int | None:
    """The delay that explains the measured speeds, unless shorter ones explain them as well."""
    if len(now.measured) < LEAST_LOOK or len(now.told) < len(now.measured) + LEAST_DELAYS - 1:
        return None
    told, measured = np.array(now.told) / SCALE, np.array(now.measured) / SCALE
    if float(np.ptp(measured, axis=0).max()) < LEAST_CHANGE:
        return None
    left, whole = _unexplained(told, measured)
    best = int(np.argmin(left))
    refuted = left > WORSE * left[best]
    sure = left[best] <= UNEXPLAINED * whole and bool(refuted[: max(0, best - 2)].all())
    return best if sure else None


def _unexplained(told: Floats, measured: Floats) -> tuple[Floats, float]:
    """What each delay leaves of the squared changes of the measured speeds, (delays,); and all."""
    views = np.lib.stride_tricks.sliding_window_view(told, len(measured), axis=0)[::-1][:DELAYS]
    models = views - views.mean(axis=2, keepdims=True)  # (delays, axes, ticks)
    changes = (measured - measured.mean(axis=0)).T  # (axes, ticks)
    both = np.einsum("dat,at->da", models, changes)
    size = np.maximum(np.einsum("dat,dat->da", models, models), 1e-9)
    whole = np.einsum("at,at->a", changes, changes)
    gains = np.clip(both / size, 0.5, 1.5)
    left = np.maximum(whole - 2 * gains * both + gains * gains * size, 0.0).sum(axis=1)
    return left + 1e-3 * len(measured), float(whole.sum())
