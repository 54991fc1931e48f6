"""The plant that suits a body: an arm on its table, a base in its room, or an arm on a base."""

from __future__ import annotations

from dualbrain.robots.model import Body
from dualbrain.simulation.plant.mobile_base_plant import BasePlant
from dualbrain.simulation.plant.mobile_manipulator_plant import CarrierPlant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec


def open_plant(spec: SceneSpec, body: Body, *, visuals: bool = False) -> Plant:
    """The world `spec` with `body` in it; `visuals` as for `Plant`."""
    kind = CarrierPlant if body.carries_arm else BasePlant if body.mobile else Plant
    return kind(spec, body, visuals=visuals)
