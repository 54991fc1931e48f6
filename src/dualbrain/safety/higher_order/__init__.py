"""Barriers of relative degree two: a filter on joint accelerations."""

from dualbrain.safety.higher_order.answer import FilteredAcceleration
from dualbrain.safety.higher_order.filter import AccelerationConfig, AccelerationFilter

__all__ = ["AccelerationConfig", "AccelerationFilter", "FilteredAcceleration"]
