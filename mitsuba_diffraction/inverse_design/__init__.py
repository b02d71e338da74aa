"""From a picture to the relief that casts it: `design` (build.py) minimises the loss of far_field.py."""

from .build import design
from .result import Design
from .verdict import Verdict

__all__ = ["Design", "Verdict", "design"]
