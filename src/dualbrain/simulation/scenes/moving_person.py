"""Motion of a simulated person or forearm: a path over time, followed with a bounded force.

The body weighs 5 kg and slides along three axes. A spring and a damper pull it to the path, k (p* − p) + c (v* − v),
with each axis limited to F/√3, so that the total force never exceeds F (150 N). Contact forces are therefore realistic,
unlike those of a body of infinite mass. MuJoCo computes the force (a position actuator with `forcerange`); this module
computes the set point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualbrain.simulation.scenes.scene_spec import MovingPerson

PERSON_STIFFNESS = 2000.0  # [N/m]
PERSON_DAMPING = 200.0  # [N s/m], critical damping for 5 kg
PERSON_ACCELERATION = 0.5  # [m/s²] along the path


@dataclass(frozen=True, slots=True, kw_only=True)
class PersonPath:
    """Motion back and forth along a line with rests at both ends: position and velocity as functions of time.

    `start` (3,) [m], unit vector `direction` (3,), `length` [m], cruising `speed` [m/s]; durations [s] of the
    acceleration `ramp`, of one way (`travel`), of each rest (`pause`), and the `phase` of the cycle at t = 0.
    """

    start: np.ndarray
    direction: np.ndarray
    length: float
    speed: float
    ramp: float
    travel: float
    pause: float
    phase: float

    @property
    def cycle_duration(self) -> float:
        """Duration [s] of one cycle: rest, way out, rest, way back."""
        return 2.0 * (self.pause + self.travel)

    def state_at(self, t: float) -> tuple[float, float]:
        """Distance from `start` [m] and its rate [m/s] at time `t` [s]."""
        tau = (t + self.phase) % self.cycle_duration
        if tau < self.pause:
            return 0.0, 0.0
        tau -= self.pause
        if tau < self.travel:
            return self._trapezoid(tau)
        tau -= self.travel
        if tau < self.pause:
            return self.length, 0.0
        distance, rate = self._trapezoid(tau - self.pause)
        return self.length - distance, -rate

    def _trapezoid(self, tau: float) -> tuple[float, float]:
        """Trapezoidal velocity profile: accelerate during `ramp`, cruise, decelerate during `ramp`."""
        if tau < self.ramp:
            return 0.5 * self.speed * tau * tau / self.ramp, self.speed * tau / self.ramp
        left = self.travel - tau
        if left < self.ramp:
            return self.length - 0.5 * self.speed * left * left / self.ramp, self.speed * left / self.ramp
        return self.speed * (tau - 0.5 * self.ramp), self.speed


def person_path(mover: MovingPerson) -> PersonPath:
    """The path of a `MovingPerson`; the speed is reduced if the path is too short to reach it."""
    start, end = np.array(mover.start), np.array(mover.end)
    length = float(np.linalg.norm(end - start))
    speed = min(mover.speed, float(np.sqrt(PERSON_ACCELERATION * length))) if length > 0.0 else mover.speed
    ramp = speed / PERSON_ACCELERATION
    travel = length / speed + ramp if length > 0.0 else 0.0
    direction = (end - start) / length if length > 0.0 else np.zeros(3)
    return PersonPath(
        start=start,
        direction=direction,
        length=length,
        speed=speed,
        ramp=ramp,
        travel=travel,
        pause=mover.pause,
        phase=mover.phase,
    )
