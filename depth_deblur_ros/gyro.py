"""
What a gyro says of the turn: its mean over the exposure, as good as it has proved to be.

Its readings between two frames are compared with the turn that the tracked points show: the mean
difference is the bias, what goes with its changes is a lag, and what varies beyond both is its
error, docs/method.md (54) to (57). So a gyro with wrong axes or a scale counts for little,
whatever its data sheet promises.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
import math
from typing import Any

from depth_deblur_ros.between import Between
from depth_deblur_ros.core.data import InputError, Vector
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.messages import stamp_ns
import numpy as np

BESIDE_NS = 10_000_000  # before and behind a time, where its change is looked for
KEPT = 4000  # readings: ten seconds at 400 Hz
NEAREST_NS = 20_000_000  # a reading farther away than this tells nothing of an exposure
MEMORY = 12.0  # frames over which the error is averaged
UNTRIED = 0.1  # rad/s; error of a gyro that no frame could test
TESTS, BLIND = 5, 5  # frames that must agree; frames without tracks after which it is taken as is
EXCUSED, SHARE = 0.03, 0.5  # rad/s; error that is allowed, and of the change from frame to frame
LAG, LONGEST_LAG, LAG_DRIFT = 0.01, 0.1, 0.0002  # s; expected at first, ever, from frame to frame
BIAS_DRIFT = 0.002  # rad/s from frame to frame
NOTHING = 1e6  # m^2/s^2; a gyro says nothing of shifts


@dataclass(frozen=True, eq=False)
class Trial:
    """
    What the frames so far say of a gyro: bias (3,), its variance, mean squared error, lag [s].

    error is what the covariance of the ways does not explain; change is the mean squared change of
    the turn (3,) from frame to frame; blind counts frames without a way to compare with.
    """

    bias: Vector
    variance: float
    error: float = UNTRIED**2
    lag: float = 0.0
    lag_variance: float = LAG**2
    change: float = 0.0
    turn: Vector | None = None
    frames: int = 0
    blind: int = 0

    @property
    def passed(self) -> bool:
        """Whether the gyro is to be trusted, (56)."""
        if self.frames < TESTS:
            return not self.frames and self.blind >= BLIND
        return self.error < EXCUSED**2 + SHARE**2 * self.change

    def compared(
        self, turn: Vector, miss: Vector, bend: Vector, variances: tuple[float, float]
    ) -> Trial:
        """
        Take in by how much a turn (3,) misses the one that was seen, (54), (55).

        bend (3,): how fast the turn changes [rad/s^2]; variances: of what was seen, of a reading.
        """
        noise = sum(variances)
        certain = noise + self.variance
        late = self.lag_variance / (self.lag_variance * float(bend @ bend) + certain)
        lag = float(np.clip(self.lag + late * float(bend @ miss), -LONGEST_LAG, LONGEST_LAG))
        miss = miss - (lag - self.lag) * bend
        change = turn - self.turn if self.turn is not None else np.zeros(3)
        share = 1 / min(self.frames + 1.0, MEMORY)
        gain = self.variance / (self.variance + noise)
        return Trial(
            bias=self.bias + gain * miss,
            variance=(1 - gain) * self.variance + BIAS_DRIFT**2,
            error=(1 - share) * self.error + share * (float(miss @ miss) / 3 - variances[0]),
            lag=lag,
            lag_variance=late * certain + LAG_DRIFT**2,
            change=(1 - share) * self.change + share * float(change @ change) / 3,
            turn=turn,
            frames=self.frames + 1,
            blind=self.blind,
        )


class Gyro:
    """The readings that came last, and what they have proved to be worth."""

    def __init__(self) -> None:
        self.trial: Trial | None = None
        self._readings: deque[tuple[int, Vector]] = deque(maxlen=KEPT)

    def take(self, msg: Any) -> None:
        """Take a sensor_msgs/Imu; a reading that is not finite is none."""
        rate = msg.angular_velocity
        reading = np.array([rate.x, rate.y, rate.z], np.float64)
        if np.isfinite(reading).all():
            self._readings.append((stamp_ns(msg.header), reading))

    def turn(self, middle_ns: int, seconds: float, params: SolverParams) -> Vector | None:
        """Give the mean turn (3,) [rad/s] of the scene around a time, in the camera's axes."""
        lag = self.trial.lag if self.trial else 0.0
        middle_ns += round(1e9 * (lag - params.gyro_delay_s))
        half = 5e8 * seconds
        reach = max(NEAREST_NS, half)
        readings = [r for r in list(self._readings) if abs(r[0] - middle_ns) <= reach]
        if not readings:
            return None
        inside = [rate for stamp, rate in readings if abs(stamp - middle_ns) <= half]
        if not inside:
            inside = [min(readings, key=lambda r: abs(r[0] - middle_ns))[1]]
        return np.asarray(-rotation(params.gyro_rotation) @ np.mean(inside, axis=0))

    def compare(
        self, first_ns: int, way: Between | None, seconds: float, params: SolverParams
    ) -> None:
        """Compare the readings since first_ns with the turn on the way from there, (54), (55)."""
        middle_ns = first_ns + round(5e8 * seconds)
        turn = self.turn(middle_ns, seconds, params)
        if turn is None:
            return
        trial = self.trial or Trial(np.zeros(3), params.gyro_bias**2)
        if way is None:
            self.trial = replace(trial, blind=trial.blind + 1)
            return
        seen = float(np.trace(way.covariance[:3, :3])) / 3 / seconds**2
        miss = way.motion[:3] / seconds - turn - trial.bias
        beside = [self.turn(middle_ns + k, seconds, params) for k in (BESIDE_NS, -BESIDE_NS)]
        self.trial = trial.compared(turn, miss, _change(*beside), (seen, params.gyro_noise**2))

    def measured(
        self, middle_ns: int, seconds: float, params: SolverParams
    ) -> tuple[Vector, Vector] | None:
        """Give the velocity (6,) at a time and its covariance (6, 6), (57), if it is trusted."""
        turn = self.turn(middle_ns, seconds, params)
        if turn is None or self.trial is None or not self.trial.passed:
            return None
        variance = params.gyro_noise**2 + self.trial.variance + max(self.trial.error, 0.0)
        spread = np.diag([variance] * 3 + [NOTHING] * 3)
        return np.concatenate([turn + self.trial.bias, np.zeros(3)]), spread


def _change(after: Vector | None, before: Vector | None) -> Vector:
    """Give how fast a turn changes, (3,) [rad/s^2]; 0 where that is not known."""
    if after is None or before is None:
        return np.zeros(3)
    return (after - before) / (2e-9 * BESIDE_NS)


def rotation(text: str) -> Vector:
    """Read a rotation (3, 3) from a quaternion 'x y z w'; InputError where it is none."""
    try:
        x, y, z, w = (float(word) for word in text.split())
    except ValueError:
        raise InputError(f"gyro_rotation must be four numbers 'x y z w', got {text!r}") from None
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not 0.99 < length < 1.01:
        raise InputError(f'gyro_rotation must be a quaternion of length 1, got {text!r}')
    x, y, z, w = x / length, y / length, z / length, w / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
