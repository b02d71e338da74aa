"""Rigorous efficiencies of one-dimensional gratings, by Maxwell's equations."""

from ..optics.refractive_indices import refractive_index
from .solver import Efficiencies, efficiencies

__all__ = ["Efficiencies", "efficiencies", "refractive_index"]
