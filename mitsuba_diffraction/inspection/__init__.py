"""Look at a surface before it is rendered: statistics, periods, predicted colours, and how far they can be trusted."""

from .inspect import Inspection, inspect
from .picture import save_picture

__all__ = ["Inspection", "inspect", "save_picture"]
