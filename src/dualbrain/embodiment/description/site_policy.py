"""What a site file and the command line say of a robot's limits, as a policy with the place of each number."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from dualbrain.embodiment.description.policy import Given, Policy
from dualbrain.embodiment.site_file import SiteFile

WHOLE = ("period", "tool_speed", "turn", "turn_acceleration", "grip_force", "grip_force_min")


def policy_of(file: SiteFile | None, options: Mapping[str, float | None]) -> Policy:
    """The policy of `file`, with `options` (acceleration, velocity, period, tool_speed, turn, …) first."""
    said = {key: Given(value, f"site policy ({_option(key)})") for key, value in options.items() if value}
    every = {side: said[side] for side in ("velocity", "acceleration", "jerk") if side in said}
    whole = {side: said[side] for side in WHOLE if side in said}
    if file is None:
        return Policy(every, {}, whole)
    site = file.site
    joints = {name: _given(file, caps, f"joint.{name}") for name, caps in site.joint.items()}
    return Policy(_given(file, site.limits, "limits") | every, joints, _given(file, site.robot, "robot") | whole)


def _option(key: str) -> str:
    return "--grip" if key.startswith("grip") else f"--{key.replace('_', '-')}"


def _given(file: SiteFile, entry: msgspec.Struct, path: str) -> dict[str, Given]:
    """Every number of `entry` that is stated."""
    return {
        side: Given(float(value), f"site policy ({file.where(f'{path}.{side}')})")
        for side, value in msgspec.structs.asdict(entry).items() if value is not None
    }  # fmt: skip
