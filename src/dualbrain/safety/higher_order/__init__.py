"""Barriers of relative degree two: a safety filter on joint accelerations."""

from dualbrain.safety.higher_order.filter import AccelerationConfig, AccelerationFilter
from dualbrain.safety.higher_order.result import FilteredAcceleration

__all__ = ["AccelerationConfig", "AccelerationFilter", "FilteredAcceleration"]
