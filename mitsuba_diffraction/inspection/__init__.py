"""Inspection of a surface before it is rendered: statistics, periods, predicted colours, and their uncertainty."""

from .inspect import Inspection, inspect
from .picture import save_picture

__all__ = ["Inspection", "inspect", "save_picture"]
