"""Every interface that takes geometric input, with a valid input, and its declared outcome for a bad value.

A bad value is either refused by an error of dualbrain (or by a refusal that is a value, such as `SourceRefused`), or,
in the state of a step, answered by a stop. In both cases the filter certifies nothing until the next valid input.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from dualbrain.control.scene_monitor import SceneMonitor
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, Pose, Sphere
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.barriers.keep_out import keep_out_region
from dualbrain.safety.barriers.traversable_region import traversable_region
from dualbrain.safety.barriers.workspace import height_limits, plane
from dualbrain.safety.cbf.filter import ConstraintRow, Contact, FilterConfig, Obstacle, SafetyFilter, SpeedAndSeparation
from dualbrain.safety.cbf.grasped_object import cover_with_spheres
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.safety.higher_order.filter import AccelerationConfig, AccelerationFilter
from dualbrain.safety.integration.scene_fusion import PerceivedShape, SceneFusion, SceneSource, SourceRefused
from dualbrain.safety.integration.shadow_mode import ShadowFilter
from experiments.interfaces.bad_values import LENGTH, NUMBER, QUATERNION, SIZES, VECTOR, WISH

TURN = (0.8, 0.0, 0.6, 0.0)
REFUSED, STOPPED = "refused", "stopped"


class Refusal(Exception):  # noqa: N818  (a refusal that the interface returns as a value)
    """An interface refused its input by a value."""


@dataclass(frozen=True, slots=True)
class Field:
    """A field of the input: its form (`bad_values`) and a valid value; `optional` fields accept None."""

    form: str
    valid: Any
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Interface:
    """One way into the filter.

    `call` takes a value for every field, and returns whether the filter certifies a step after it. If `step` is set,
    numbers that are not finite or too large are answered by a stop instead of an error.
    """

    fields: Mapping[str, Field]
    call: Callable[[dict[str, Any]], bool]
    step: bool = False
    certifies: Callable[[], bool] | None = None
    """After a refused call: whether the filter still certifies a step. None if the interface holds no filter."""


PLACED = {
    "position": Field(VECTOR, (0.9, 0.3, 0.6)),
    "quaternion": Field(QUATERNION, TURN),
    "velocity": Field(VECTOR, (0.0, 0.0, 0.0)),
    "velocity_error": Field(LENGTH, 0.0),
}
SHAPES: dict[str, tuple[type[Any], dict[str, Field]]] = {
    "sphere": (Sphere, {"radius": Field(LENGTH, 0.05)}),
    "capsule": (Capsule, {"radius": Field(LENGTH, 0.05), "half_length": Field(LENGTH, 0.1)}),
    "box": (Box, {"half_extents": Field(SIZES, (0.05, 0.06, 0.07))}),
}
PERCEIVED_SHAPES = SHAPES | {
    "cylinder": (Cylinder, {"radius": Field(LENGTH, 0.05), "half_height": Field(LENGTH, 0.1)}),
    "bowl": (Bowl, {"radius": Field(LENGTH, 0.05), "height": Field(LENGTH, 0.1), "wall": Field(LENGTH, 0.01)}),
}


class Testbed:
    """Filters of one arm, shared by all interfaces; every valid call restores them."""

    def __init__(self) -> None:
        """Build the filters of the Panda with every fourth sphere."""
        whole = load_robot("panda")
        self.robot_model = msgspec.structs.replace(whole, spheres=whole.spheres[::4])
        self.home, self.rest = tuple(whole.home), (0.0,) * whole.n
        self.safety, self.higher = SafetyFilter(self.robot_model), AccelerationFilter(self.robot_model)
        self.shadow = ShadowFilter(SafetyFilter(self.robot_model))

    def certifies(self) -> bool:
        """Whether the filter certifies a step at rest."""
        return self.safety(self.home, self.rest, self.rest).certified

    def certifies_accelerations(self) -> bool:
        """Whether the filter on accelerations accepts a step at rest."""
        return self.higher(self.home, self.rest, self.rest).status < 3

    def interfaces(self) -> dict[str, Interface]:
        """All interfaces by name."""
        found = self._observations() | self._updates() | self._steps() | self._configurations() | self._barriers()
        return found | self._perception()

    # --- scenes -------------------------------------------------------------------------------------------------

    def _observations(self) -> dict[str, Interface]:
        found: dict[str, Interface] = {}
        for name, (kind, sizes) in SHAPES.items():
            fields = sizes | PLACED | {"margin": Field(LENGTH, 0.01), "alpha": Field(LENGTH, 2.0, optional=True)}

            def make(given: dict[str, Any], kind: type[Any] = kind, sizes: Any = tuple(sizes)) -> Obstacle:
                pose = Pose(given["position"], given["quaternion"])
                rest = {key: given[key] for key in ("velocity", "velocity_error", "margin", "alpha")}
                return Obstacle("thing", kind(**{key: given[key] for key in sizes}), pose, **rest)

            def observe(given: dict[str, Any], make: Any = make) -> bool:
                self.safety.observe([make(given)], given["stamp"])
                return self.certifies()

            def fixed(given: dict[str, Any], make: Any = make) -> bool:
                return SafetyFilter(self.robot_model, obstacles=[make(given)])(
                    self.home, self.rest, self.rest
                ).certified

            def accelerations(given: dict[str, Any], make: Any = make) -> bool:
                self.higher.observe([make(given)], given["stamp"])
                return self.certifies_accelerations()

            stamped = fields | {"stamp": Field(NUMBER, 0.0)}
            found[f"observe {name}"] = Interface(stamped, observe, certifies=self.certifies)
            found[f"permanent {name}"] = Interface(fields, fixed)
            found[f"accelerations {name}"] = Interface(stamped, accelerations, certifies=self.certifies_accelerations)
        return found

    def _perception(self) -> dict[str, Interface]:
        found: dict[str, Interface] = {}
        for name, (kind, sizes) in PERCEIVED_SHAPES.items():
            found |= self._perceived(name, kind, sizes)
        return found

    def _perceived(self, name: str, kind: type[Any], sizes: dict[str, Field]) -> dict[str, Interface]:
        fields = sizes | PLACED | {"error": Field(LENGTH, 0.004)}

        def shape_of(given: dict[str, Any]) -> Any:
            return kind(**{key: given[key] for key in sizes})

        def make(given: dict[str, Any]) -> SceneObject:
            pose = Pose(given["position"], given["quaternion"])
            rest = {key: given[key] for key in ("velocity", "velocity_error", "error", "stamp") if key in given}
            return SceneObject(name="thing", role="object", shape=shape_of(given), pose=pose, **rest)

        def scene(given: dict[str, Any]) -> Scene:
            return Scene(robot="panda", stamp=0.0, version=1, objects=(make(given),))

        def from_scene(given: dict[str, Any]) -> bool:
            self.safety.observe(obstacles_from_scene(scene(given), known=(), held=None))
            return self.certifies()

        def monitor(given: dict[str, Any]) -> bool:
            if SceneMonitor().update(scene(given)):
                raise Refusal
            return True

        def grasp(given: dict[str, Any]) -> bool:
            cover_with_spheres(make(given), np.zeros(3), np.eye(3))
            return True

        def fusion(given: dict[str, Any]) -> bool:
            pose = Pose(given["position"], given["quaternion"])
            rest = {key: given[key] for key in ("velocity", "velocity_error", "error")}
            fused = SceneFusion({"camera": SceneSource(error=0.0, max_age=1.0)})
            seen = PerceivedShape(name="thing", shape=shape_of(given), pose=pose, **rest)
            if isinstance(fused.update("camera", "world", 0.0, [seen], now=0.0), SourceRefused):
                raise Refusal
            return True

        stamped = fields | {"stamp": Field(NUMBER, 0.0)}
        return {
            f"scene {name}": Interface(stamped, from_scene),
            f"scene monitor {name}": Interface(stamped, monitor),
            f"grasped {name}": Interface(stamped, grasp),
            f"scene fusion {name}": Interface(fields, fusion),
        }

    # --- held object, rows, contacts ----------------------------------------------------------------------------

    def _updates(self) -> dict[str, Interface]:
        def attach(given: dict[str, Any]) -> bool:
            try:
                row = (*given["centre"], given["radius"])
            except TypeError:
                row = (given["centre"], given["radius"])
            self.safety.attach([row], given["error"])
            return self.certifies()

        def constrain(given: dict[str, Any]) -> bool:
            self.safety.constrain([ConstraintRow(name="row", a=given["a"], b=given["b"])])
            return self.certifies()

        def permit(given: dict[str, Any]) -> bool:
            self.safety.permit([Contact("hand", "thing", given["speed"])])
            return self.certifies()

        held = {
            "centre": Field(VECTOR, (0.0, 0.0, 0.05)),
            "radius": Field(LENGTH, 0.02),
            "error": Field(LENGTH, 0.001),
        }
        rows = {"a": Field(VECTOR, (1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.2)), "b": Field(NUMBER, -5.0)}
        return {
            "attach": Interface(held, attach, certifies=self.certifies),
            "constrain": Interface(rows, constrain, certifies=self.certifies),
            "permit": Interface({"speed": Field(LENGTH, 0.05)}, permit),
        }

    def restore(self) -> None:
        """Bring all filters back to an empty scene."""
        for safety in (self.safety, self.shadow.safety):
            safety.observe(())
            safety.detach()
            safety.constrain(())
            safety.permit(())
            safety.reset()
        self.higher.observe(())
        self.shadow.reset()

    # --- steps --------------------------------------------------------------------------------------------------

    def _steps(self) -> dict[str, Interface]:
        state = {"q": Field(VECTOR, self.home), "v": Field(VECTOR, self.rest), "u_nom": Field(WISH, self.rest)}
        single = state | {"now": Field(WISH, 0.0), "opening": Field(NUMBER, 0.02, optional=True)}

        def call(given: dict[str, Any]) -> bool:
            return self.safety(**given).certified

        def by_state(given: dict[str, Any]) -> bool:
            now = given["now"]
            known = RobotState(
                stamp=now, sequence=0, q=given["q"], v=given["v"], opening=given["opening"], finger_forces=(0.0, 0.0)
            )
            return self.safety.filter(known, given["u_nom"], now).certified

        def batch(given: dict[str, Any]) -> bool:
            rows = {key: [given[name]] for key, name in (("Q", "q"), ("V", "v"), ("U", "u_nom"))}
            got = self.safety.batch(**rows, now=given["now"], opening=given["opening"])
            return bool(got.status[0] < 3)

        def shadow(given: dict[str, Any]) -> bool:
            return self.shadow.evaluate(given["q"], given["v"], given["u_nom"], 0.0, opening=given["opening"]).certified

        def accelerations(given: dict[str, Any]) -> bool:
            return self.higher(**given).status < 3

        shadowed = state | {"opening": single["opening"]}
        return {
            "step": Interface(single, call, step=True),
            "step by state": Interface(single, by_state, step=True),
            "batch": Interface(single, batch, step=True),
            "shadow mode": Interface(shadowed, shadow, step=True),
            "step of accelerations": Interface(single, accelerations, step=True),
        }

    # --- configurations and barriers ----------------------------------------------------------------------------

    def _configurations(self) -> dict[str, Interface]:
        def config(given: dict[str, Any]) -> bool:
            return bool(FilterConfig(**given))

        def replaced(given: dict[str, Any]) -> bool:
            return bool(msgspec.structs.replace(FilterConfig(), **given))

        def accelerations(given: dict[str, Any]) -> bool:
            return bool(AccelerationConfig(**given))

        def separation(given: dict[str, Any]) -> bool:
            return bool(SpeedAndSeparation(**given))

        optional = {name: Field(LENGTH, 2.0, optional=True) for name in ("alpha", "alpha_self", "tracking_error")}
        margins = {
            name: Field(LENGTH, 1e-4)
            for name in ("sampling_margin", "rounding_margin", "self_margin", "projection_margin")
        }
        ages = {name: Field(LENGTH, 0.1) for name in ("scene_stale_after", "state_stale_after", "recovery_speed")}
        return {
            "FilterConfig": Interface(optional | margins | ages, config),
            "FilterConfig replaced": Interface(optional | margins | ages, replaced),
            "AccelerationConfig": Interface(
                {name: Field(LENGTH, 0.1) for name in ("acceleration_error", "self_margin", "scene_stale_after")},
                accelerations,
            ),
            "SpeedAndSeparation": Interface(
                {name: Field(LENGTH, 1.0) for name in ("reaction", "brake", "approach")}, separation
            ),
        }

    def _barriers(self) -> dict[str, Interface]:
        def planes(given: dict[str, Any]) -> bool:
            self.safety.observe([plane("wall", given["point"], given["inward"], margin=given["margin"])])
            return self.certifies()

        def keep_out(given: dict[str, Any]) -> bool:
            self.safety.observe([keep_out_region("stairs", **given)])
            return self.certifies()

        def region(given: dict[str, Any]) -> bool:
            traversable_region("hall", [given["first"], (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)])
            return True

        def heights(given: dict[str, Any]) -> bool:
            self.safety.observe(height_limits(given["lowest"], 2.0))
            return self.certifies()

        wall = {
            "point": Field(VECTOR, (-2.0, -2.0, -2.0)),
            "inward": Field(VECTOR, (1.0, 0.1, 0.2)),
            "margin": Field(LENGTH, 0.01),
        }
        floor = {"x": Field(NUMBER, -3.0), "y": Field(NUMBER, -3.0), "yaw": Field(NUMBER, 0.3)}
        return {
            "plane": Interface(wall, planes),
            "keep-out region": Interface(
                floor | {"half_x": Field(LENGTH, 0.2), "half_y": Field(LENGTH, 0.2)}, keep_out
            ),
            "traversable region": Interface({"first": Field(VECTOR, (-9.0, -9.0))}, region),
            "height limits": Interface({"lowest": Field(NUMBER, -1.0)}, heights),
        }
