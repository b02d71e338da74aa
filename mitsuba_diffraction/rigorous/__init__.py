"""Rigorous efficiencies of one-dimensional gratings, by Maxwell's equations."""

from .efficiencies import Efficiencies, efficiencies
from .materials import refractive_index

__all__ = ["Efficiencies", "efficiencies", "refractive_index"]
