"""The path tracer with this project's BSDF against the real-time shader, on one scene."""

from .side_by_side import Comparison, ComparisonRequest, compare

__all__ = ["Comparison", "ComparisonRequest", "compare"]
