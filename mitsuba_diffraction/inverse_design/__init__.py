"""From a picture to the relief that casts it: `design` (search.py) minimises the loss of far_field.py."""

from .result import Design
from .search import design
from .verdict import Verdict

__all__ = ["Design", "Verdict", "design"]
