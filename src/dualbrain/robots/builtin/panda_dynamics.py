"""Masses of the Franka Emika Panda with its hand, and its torque sensors."""

from __future__ import annotations

from dualbrain.robots.model import Bound, DynamicModel, ForceSensing, RigidBody, Vector

Inertia = tuple[float, float, float, float, float, float]

# chain frame, mass [kg], centre [m], inertia about the centre (xx, yy, zz, xy, xz, yz) [kg m²]
BODIES: tuple[tuple[int, float, Vector, Inertia], ...] = (
    (1, 4.97068, (0.003875, 0.002081, -0.04762), (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),
    (2, 0.646926, (-0.003141, -0.02872, 0.003495), (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),
    (3, 3.2286, (0.027518, 0.039252, -0.066502), (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805)),
    (4, 3.5879, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    (5, 1.22595, (-0.011953, 0.041065, -0.038437), (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
    (6, 1.66656, (0.060149, -0.014117, -0.010517), (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
    (7, 0.735522, (0.010517, -0.004252, 0.061597), (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741)),
    (7, 0.76, (-0.006792, 0.006792, 0.139108), (0.0018405, 0.0018405, 0.0017087, 0.00074928, -1.088e-05, 1.088e-05)),
)
"""The links 1 to 7, then the hand with closed fingers."""

DYNAMICS = DynamicModel(
    bodies=tuple(
        RigidBody(frame=frame, mass=mass, centre=centre, inertia=inertia) for frame, mass, centre, inertia in BODIES
    ),
    rotor_inertia=(0.1,) * 7,
    damping=(0.003,) * 7,
    payload=Bound(3.0, "kg", "data sheet of the arm, without its hand"),
    provenance="links: Gaz, Cognetti, Oliva, Robuffo Giordano, De Luca, IEEE RA-L 4(4), 2019; hand: manufacturer's "
    "mass of 0.73 kg, fingers of 15 g; rotor inertia and damping: assumed, those of the simulated plant",
)
FORCE_SENSING = ForceSensing(
    kind="motor_torques",
    noise=(0.05,) * 7,
    accuracy=(0.15,) * 7,
    provenance="torque sensors of the joints; noise and constant error [Nm] are assumed for the simulated plant and "
    "not measured on an arm",
)
