from collections.abc import Callable
from types import EllipsisType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.safety.cbf.result import FilterResult, FilterStatus, RowNames

Array = NDArray[np.float64]

real: str
source_hash: str
flags: str
max_rows: int
max_joints: int
max_links: int
max_pairs: int
max_obstacles: int
max_spheres: int
max_held: int
max_user: int

class Kernel:
    def __init__(self, model: dict[str, Any]) -> None: ...
    def set_obstacles(self, rows: Array) -> None: ...
    def clear_permits(self) -> None: ...
    def permit(self, link: int, obstacle: int, speed: float) -> None: ...
    def limit_near(self, obstacle: int, speed: float, distance: float, brake: float, approach: float) -> None: ...
    def attach(self, spheres: Array, error: float) -> None: ...
    def constrain(self, rows: Array) -> None: ...
    def set_base_pose(self, pose: Array) -> None: ...
    def reset(self, u_prev: Array, u_change: Array) -> None: ...
    def set_result_type(self, type: Callable[..., FilterResult], statuses: tuple[FilterStatus, ...]) -> None: ...
    def step(
        self,
        q: ArrayLike,
        v: ArrayLike,
        u_nom: ArrayLike,
        opening: float | EllipsisType,
        state_age: float,
        scene_age: float,
        names: RowNames,
    ) -> FilterResult: ...
    def batch(
        self,
        q: Array,
        v: Array,
        u_nom: Array,
        u_prev: Array,
        opening: Array,
        scene_age: float,
        u: Array,
        status: NDArray[np.int8],
        delta: Array,
        h_min: Array,
        flags: NDArray[np.int32],
    ) -> None: ...
    def project(
        self,
        q: ArrayLike,
        v: ArrayLike,
        u_nom: ArrayLike,
        u_prev: Array,
        opening: float | EllipsisType,
        state_age: float,
        scene_age: float,
        extra: float,
        u: Array,
    ) -> int: ...
    def tool(self, q: Array, to: Array) -> None: ...
    def spheres(self, q: Array, opening: float, to: Array) -> int: ...
    def rows(self) -> list[tuple[int, int, int, float, float, float, tuple[float, ...]]]: ...
    def box(self) -> tuple[tuple[float, ...], tuple[float, ...]]: ...
    def closed_loop(
        self,
        q: Array,
        seed: int,
        hold: int,
        toward: float,
        q_log: Array,
        u_log: Array,
        status_log: NDArray[np.int8],
    ) -> dict[str, float]: ...
    def handles(self) -> tuple[object, object, object]: ...
    def debug_readout(self, extra: float, known_only: bool) -> dict[str, dict[str, bytes]]: ...
    def fill_memory(self, byte: int) -> None: ...
    def time_steps(self, q: Array, u_nom: Array, cold: bool) -> float: ...

class Dynamics:
    def __init__(self, arm: dict[str, Any]) -> None: ...
    def torque(self, q: Array, v: Array, a: Array, base: Array, to: Array) -> None: ...

def contact_force(jacobian: Array, torque: Array, damping: float, to: Array) -> None: ...
def locate_contact(
    jacobian: Array,
    tool: Array,
    points: Array,
    joint_count: NDArray[np.int32],
    torque: Array,
    damping: float,
    to: Array,
) -> int: ...
def damped_step(jacobian: Array, damping: float, task: Array, free: Array, u: Array) -> None: ...
def solve_qp(
    scale: Array, A: Array, b: Array, lower: Array, upper: Array, u_nom: Array, u: Array
) -> tuple[int, int, tuple[tuple[int, float], ...]]: ...
def solve_qp_warm(
    scale: Array,
    A_b_soft: tuple[Array, Array, Array],
    lower: Array,
    upper: Array,
    u_nom: Array,
    slack: bool,
    shift: float,
    warm: list[int],
    u: Array,
) -> tuple[int, int, float, tuple[tuple[int, float], ...]]: ...
def check(A: Array, b: Array, lower: Array, upper: Array, u: Array, tolerance: float) -> bool: ...
def distance(obstacle: Array, points: Array, d: Array, normals: Array) -> None: ...
def sincos(x: float) -> tuple[float, float]: ...

class ReferenceDistance:
    def __init__(self, robot: dict[str, Any]) -> None: ...
    def measure(self, q: Array, obstacles: Array, period: float, to: Array) -> None: ...
    def run_worst_case_loop(
        self,
        handles: tuple[object, object, object],
        obstacles: Array,
        settings: dict[str, Any],
        q: Array,
        q_log: Array,
    ) -> dict[str, Any]: ...
