"""Inspection of a surface before it is rendered: statistics, periods, predicted colours, and their uncertainty."""

from .picture import save_picture
from .properties import Inspection, inspect

__all__ = ["Inspection", "inspect", "save_picture"]
