"""Gratings as Maxwell's equations have them: rigorous efficiencies of surfaces of one row."""

from .efficiencies import Efficiencies, efficiencies
from .materials import refractive_index

__all__ = ["Efficiencies", "efficiencies", "refractive_index"]
