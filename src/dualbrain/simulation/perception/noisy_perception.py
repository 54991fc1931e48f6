"""Noisy perception: the ground truth with a declared delay, a bounded position error and missed detections.

The position error e ∈ R³ of each object follows e' = ρ e + sqrt(1 − ρ²) w with w ~ N(0, σ² I) and ρ = exp(−Δt/T): a
calibration error that drifts slowly (T seconds) instead of jumping with each observation. It is redrawn until
‖e'‖ ≤ 3σ, so 3σ always bounds the *norm*; `SceneObject.error` carries that bound. A person's velocity error is uniform
in a ball of the declared radius. Sizes, orientations, identities, supports, places and the map of the floor are exact.
Objects on the table are assumed to be at rest (velocity zero): only a person's velocity is estimated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Capsule, HalfSpace, Pose, Vector
from dualbrain.errors import ConfigurationError
from dualbrain.records import Scene, SceneObject
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, SceneSpec, keep_out_objects

TRUNCATION_SIGMAS = 3.0
TABLE_OBJECT = SceneObject(
    name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)), category="table"
)


class PerceptionNoise(msgspec.Struct, frozen=True, kw_only=True):
    """The declared noise model.

    `sigma` [m] is the standard deviation per axis before the truncation, which leaves 0.96 σ; `correlation_time` [s]
    is T (0: an independent error for each observation); `velocity_error` [m/s] bounds the error of a person's velocity;
    `latency` [s] is the age of the returned observation; `dropout_probability` is the probability that an observation
    misses an object (its last observation stays, with its old stamp); `hidden_objects` are never perceived.
    """

    sigma: float = 0.003
    correlation_time: float = 0.5
    velocity_error: float = 0.02
    latency: float = 0.0
    dropout_probability: float = 0.0
    hidden_objects: frozenset[str] = frozenset()

    @property
    def max_error(self) -> float:
        """Largest norm of a position error [m]."""
        return TRUNCATION_SIGMAS * self.sigma


NO_NOISE = PerceptionNoise(sigma=0.0, velocity_error=0.0)


class NoisyPerception:
    """A perception model that adds noise to the ground truth of a plant; all random numbers come from one generator."""

    def __init__(self, spec: SceneSpec, noise: PerceptionNoise, rng: np.random.Generator) -> None:
        """Perceive `spec` with `noise` drawn from `rng`; raises `ConfigurationError` for invalid noise."""
        finite = all(0.0 <= value < np.inf for value in (noise.sigma, noise.velocity_error, noise.latency))
        if not (finite and noise.correlation_time >= 0.0 and 0.0 <= noise.dropout_probability < 1.0):
            allowed = "finite values of 0 or more (correlation_time may be infinite), dropout_probability below 1"
            raise ConfigurationError("perception noise", got=noise, allowed=allowed)
        self.noise, self._spec, self._rng = noise, spec, rng
        self._errors: dict[str, NDArray[np.float64]] = {}
        self._seen: dict[str, SceneObject] = {}
        self._last_capture: float | None = None
        self._captures: deque[tuple[float, tuple[SceneObject, ...]]] = deque()
        self._names: tuple[str, ...] = ()
        self._version = 0

    def close(self) -> None:
        """Do nothing: this perception model holds no resources."""

    def perceive(self, plant: Plant) -> Scene:
        """The scene as perceived now; `stamp` of each object is the time of its observation [s].

        Until the first observation is `latency` old, it is returned with its true stamp.
        """
        now = plant.now
        self._capture(plant, now)
        while len(self._captures) > 1 and self._captures[1][0] <= now - self.noise.latency + 1e-9:
            self._captures.popleft()
        seen = self._captures[0][1]
        names = tuple(obj.name for obj in seen)
        if names != self._names:
            self._names, self._version = names, self._version + 1
        table = msgspec.structs.replace(TABLE_OBJECT, stamp=now)
        support = () if self._spec.region else (table,)
        objects = (*support, *seen, *keep_out_objects(self._spec, now))
        return Scene(
            robot=self._spec.robot,
            stamp=now,
            version=self._version,
            objects=objects,
            places=self._spec.places,
            region=self._spec.floor,
        )

    def _capture(self, plant: Plant, now: float) -> None:
        elapsed = 0.0 if self._last_capture is None else now - self._last_capture
        self._last_capture = now
        objects: Mapping[str, ObjectSpec] = {obj.name: obj for obj in self._spec.objects}
        for name in plant.object_names:
            error = self._drift_error(name, elapsed)
            missed = self.noise.dropout_probability > 0.0 and self._rng.random() < self.noise.dropout_probability
            if name in self.noise.hidden_objects or missed:
                continue
            seen = (
                self._perceive_object(plant, objects[name], error)
                if name in objects
                else self._perceive_person(plant, name, error)
            )
            self._seen[name] = msgspec.structs.replace(seen, stamp=now)
        self._captures.append((now, tuple(self._seen[name] for name in plant.object_names if name in self._seen)))

    def _perceive_object(self, plant: Plant, obj: ObjectSpec, error: NDArray[np.float64]) -> SceneObject:
        if obj.role == "support":
            error, bound = np.zeros(3), 0.0
        else:
            bound = self.noise.max_error
        return SceneObject(
            name=obj.name,
            role=obj.role,
            shape=obj.shape,
            pose=_shift_pose(plant.true_pose(obj.name), error),
            error=bound,
            category=obj.category,
            colour=obj.colour,
            fragile_limit=obj.fragile_limit,
        )

    def _perceive_person(self, plant: Plant, name: str, error: NDArray[np.float64]) -> SceneObject:
        mover = self._spec.mover
        assert mover is not None
        velocity = plant.object_velocity(name) + self._random_in_ball(self.noise.velocity_error)
        return SceneObject(
            name=name,
            role="person",
            shape=Capsule(mover.radius, mover.half_length),
            pose=_shift_pose(plant.true_pose(name), error),
            velocity=_vector(velocity),
            error=self.noise.max_error,
            velocity_error=self.noise.velocity_error,
            category="person",
            colour="",
        )

    def _drift_error(self, name: str, elapsed: float) -> NDArray[np.float64]:
        sigma = self.noise.sigma
        if sigma == 0.0:
            return np.zeros(3)
        before = self._errors.get(name)
        keep = (
            0.0
            if before is None or self.noise.correlation_time == 0.0
            else float(np.exp(-elapsed / self.noise.correlation_time))
        )
        start = np.zeros(3) if before is None else keep * before
        spread = sigma * np.sqrt(1.0 - keep * keep)
        error = start + spread * self._rng.standard_normal(3)
        while np.linalg.norm(error) > self.noise.max_error:
            error = start + spread * self._rng.standard_normal(3)
        self._errors[name] = error
        return error

    def _random_in_ball(self, radius: float) -> NDArray[np.float64]:
        """A random point (3,), uniform in the ball of `radius`."""
        direction = self._rng.standard_normal(3)
        return radius * float(self._rng.random()) ** (1.0 / 3.0) * direction / np.linalg.norm(direction)


def _shift_pose(pose: Pose, error: NDArray[np.float64]) -> Pose:
    return Pose(_vector(np.array(pose.position) + error), pose.quaternion)


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)
