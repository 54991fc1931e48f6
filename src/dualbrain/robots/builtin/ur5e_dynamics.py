"""Masses of the UR5e with its gripper, and the torques of its motors."""

from __future__ import annotations

from dualbrain.robots.model import Bound, DynamicModel, ForceSensing, RigidBody, Vector

Inertia = tuple[float, float, float, float, float, float]

# chain frame, mass [kg], centre [m], inertia about the centre (xx, yy, zz, xy, xz, yz) [kg m²]
BODIES: tuple[tuple[int, float, Vector, Inertia], ...] = (
    (1, 3.7, (0.0, 0.0, 0.0), (0.0102675, 0.0102675, 0.00666, 0.0, 0.0, 0.0)),
    (2, 8.393, (-0.2125, 0.0, 0.138), (0.0151074, 0.133886, 0.133886, 0.0, 0.0, 0.0)),
    (3, 2.275, (-0.1961, 0.0, 0.007), (0.004095, 0.0312094, 0.0312094, 0.0, 0.0, 0.0)),
    (4, 1.219, (0.0, 0.0, 0.0), (0.0025599, 0.0025599, 0.0021942, 0.0, 0.0, 0.0)),
    (5, 1.219, (0.0, 0.0, 0.0), (0.0025599, 0.0025599, 0.0021942, 0.0, 0.0, 0.0)),
    (6, 0.1879, (0.0, 0.0, -0.0229), (9.89041e-05, 9.89041e-05, 0.000132117, 0.0, 0.0, 0.0)),
    (6, 0.925, (0.0, 0.0, 0.06473), (0.001871, 0.0017384, 0.00084064, 0.0, 0.0, 0.0)),
)
"""The links 1 to 6, then the closed gripper."""

DYNAMICS = DynamicModel(
    bodies=tuple(
        RigidBody(frame=frame, mass=mass, centre=centre, inertia=inertia) for frame, mass, centre, inertia in BODIES
    ),
    rotor_inertia=(0.1,) * 6,
    damping=(0.003,) * 6,
    payload=Bound(5.0, "kg", "UR5e technical data sheet, without a gripper"),
    provenance="links: ur5e.urdf of Universal_Robots_ROS2_Description; gripper: mass of 0.925 kg of Robotiq's 2F-85 "
    "data sheet; rotor inertia and damping: assumed, those of the simulated plant",
)
FORCE_SENSING = ForceSensing(
    kind="motor_torques",
    noise=(0.3, 0.3, 0.3, 0.1, 0.1, 0.1),
    accuracy=(0.5, 0.5, 0.5, 0.2, 0.2, 0.2),
    provenance="currents of the motors; noise and constant error [Nm] are assumed for the simulated plant and not "
    "measured on an arm, whose friction makes them larger",
)
