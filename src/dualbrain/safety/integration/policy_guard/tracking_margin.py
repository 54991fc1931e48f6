"""Check that a filter has a margin for joints that do not follow its control exactly."""

from __future__ import annotations

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig


def check_tracking_margin(robot_model: RobotModel, config: FilterConfig) -> None:
    """Refuse a robot whose tracking error is not identified, such as an imported one, unless `config` states a margin.

    Raises:
        ConfigurationError: `FilterConfig.tracking_error` is None, and the position error of every joint is 0.
    """
    if config.tracking_error is not None or max(robot_model.tracking.position_errors(robot_model.n)) > 0.0:
        return
    raise ConfigurationError.stating(
        f"The tracking error of {robot_model.name} is not identified: the filter would have no margin for the sag and "
        "the lag of its joints.",
        fix="Measure lag and position error of the joints (of a simulated drive: `dualbrain robot identify`), and "
        "enter them as `tracking` in body.json of the robot folder. Or state the margin in Python, "
        "`FilterConfig(tracking_error=...)` [rad/s]; 0.0 is for joints that follow exactly.",
    )
