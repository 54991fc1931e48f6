"""Barriers for any control-affine system, written as CasADi expressions (`pip install 'dualbrain[symbolic]'`)."""

from dualbrain.safety.control_affine.filter import ControlAffineFilter
from dualbrain.safety.control_affine.result import FilteredControl
from dualbrain.safety.control_affine.system import Barrier, ControlAffine

__all__ = ["Barrier", "ControlAffine", "ControlAffineFilter", "FilteredControl"]
