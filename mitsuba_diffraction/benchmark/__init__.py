"""Speed against error: what each representation costs, what it gets wrong, and how well surfaces are sampled."""

from . import report
from .approximation import Approximation
from .cases import Case, bundled_cases, scan_case
from .run import Result, run
from .sampling import Sampling, measure

__all__ = ["Approximation", "Case", "Result", "Sampling", "bundled_cases", "measure", "report", "run", "scan_case"]
