"""An arm as an obstacle of another arm: each of two arms that are both filtered has half of the responsibility.

The rows of one arm treat the other as standing still, with half of the gain α of the filter:

    n'J_A u_A ≥ −(α/2) h,    −n'J_B u_B ≥ −(α/2) h,    hence ḣ = n'J_A u_A − n'J_B u_B ≥ −α h

h is the distance of a sphere of A from a sphere of B; both filters have the same pairs, normals n and values h, because
each takes the spheres of the other arm from the same robot model, at y = q + lag v (decentralised barrier certificates;
Wang, Ames, Egerstedt, IEEE Trans. Robotics 33(3), 2017). The velocity of the other arm is not needed. Each arm may come
to rest at any time, while the other one does anything within its half, and an action of several periods takes at most
half of the distance. Each row has the tracking margin of its own arm, so that h has those of both.
"""

from __future__ import annotations

from collections.abc import Mapping

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank
from dualbrain.simulation.environments.mujoco_arm import MujocoArm

Parts = tuple[str, ...]
SHARE = 0.5
"""Share of each of two arms in the gain of their rows."""


class ArmSpheres:
    """The collision spheres of one arm as obstacles of the other arms."""

    def __init__(self, name: str, arm: MujocoArm, config: FilterConfig, parts: Mapping[str, Parts]) -> None:
        """The spheres of `arm`, called "`name`/group of the link"; `config` is that of both filters.

        `parts` names, for a group of links of `arm`, the parts of the other arm that keep away from it; all parts keep
        away from a group that is not in it.
        """
        self._name, self._arm, self._parts = name, arm, parts
        self._model = SafetyFilter(arm.robot_model, config)
        self._lag = arm.robot_model.tracking.lag if config.lag_compensation else 0.0
        self._alpha = SHARE * (config.alpha or arm.robot_model.alpha)

    def observe(self, observer: MujocoArm) -> list[Obstacle]:
        """The spheres, at the present state of the simulation, in the frame of the base of the `observer`."""
        centres, radii, groups = self._model.spheres(self._arm.q + self._lag * self._arm.v, None)
        data, base = self._arm.data, self._arm.base
        world = centres @ data.xmat[base].reshape(3, 3).T + data.xpos[base]
        local = (world - data.xpos[observer.base]) @ data.xmat[observer.base].reshape(3, 3)
        return [
            Obstacle(
                name=f"{self._name}/{group}",
                shape=Sphere(radius),
                pose=Pose((x, y, z)),
                rank=Rank.BODY,
                alpha=self._alpha,
                parts=self._parts.get(group, ()),
            )
            for (x, y, z), radius, group in zip(local.tolist(), radii.tolist(), groups, strict=True)
        ]
