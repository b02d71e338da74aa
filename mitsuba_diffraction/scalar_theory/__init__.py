"""Scalar theory in float64: direct sums (reference), efficiencies in closed form, and where the theory is valid."""

from .closed_form import efficiency_difference
from .validity import equivalent_depth, error_map, expected_error, scalar_error

__all__ = ["efficiency_difference", "equivalent_depth", "error_map", "expected_error", "scalar_error"]
