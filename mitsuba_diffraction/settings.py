"""The parameters of a spectrum and their checks; the lobe of a coherence length; checks of q and κ."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from statistics import NormalDist
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import RequestError, check_whole, is_number

MIN_WAVELENGTH = 50.0  # nm, of a spectrum
VISIBLE = (360.0, 830.0)  # nm: the range of the CIE 1931 observer, from which Mitsuba draws wavelengths

FROM_RADIUS = {"radial": 0.0, "tangential": 90.0}  # degrees from the radius to the pattern's x axis
SUN_COHERENCE_LENGTH = 65.0  # µm, for the angular diameter of 0.53°
# 1 nm to 1 m; outside, lobes under- or overflow in floating point.
MIN_COHERENCE_LENGTH, MAX_COHERENCE_LENGTH = 1e-3, 1e6

EXTENTS = ("tile", "sample")
# "auto" is "slices"; the others are series of the amplitude.
SERIES = ("taylor", "chebyshev")
REPRESENTATIONS = ("auto", "slices", *SERIES)
ORIGINS = ("mean", "lowest")
MAX_TERMS = 999
MIN_TOLERANCE, MIN_RIGOROUS_TOLERANCE = 1e-5, 1e-4
# Default tolerances: of separate orders, and of surfaces whose spectrum scatters or whose orders overlap.
ORDERS_TOLERANCE, CONTINUUM_TOLERANCE = 1e-3, 1e-2
TAIL_FRACTION = 0.4  # of the tolerance, for the truncated tails of the lobes

# Light that enters a dielectric is absorbed, stays in it, or is transmitted by a plane below.
TRANSMISSIONS = ("none", "interface", "sheet")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The parameters that a spectrum has in both theories; `Settings.of` makes the parameters of one theory.

    Recipes, scenes, the command line and `precompute` take the parameters of both by name, and `theory`: "scalar", or
    "rigorous" (Maxwell's equations, for a tile of one row and one material only).

    Attributes:
        coherence_length: L_c in µm.
        wavelengths: (shortest, longest) in nm; in a scene the default is divided by the index next to the relief
            (`wavelengths_inside`).
        tolerance: bound of the error. In scalar theory, of max over κ of ∫|S_approx(q; κ) − S_exact(q; κ)| dq, a
            fraction of the reflected power; by default 1e-2, and 1e-3 for one tile whose orders do not overlap. With
            `terms` it may be one or more, for a picture of a series that is known to be wrong. In rigorous theory, of
            `RigorousSpectrum.error`, by default 1e-2.
        largest_height_range: in µm; deeper surfaces are refused, since their heights may be in nm. Time and memory grow
            with the height range.

    Raises:
        ValueError: if one is out of range, or they contradict each other.
    """

    theory: ClassVar[str]
    min_tolerance: ClassVar[float]
    refusal: ClassVar[str]
    """What is wrong with parameters of the other theory."""

    coherence_length: float = SUN_COHERENCE_LENGTH
    wavelengths: tuple[float, float] = VISIBLE
    tolerance: float | None = None
    largest_height_range: float = 20.0

    @staticmethod
    def of(theory: str = "scalar", **given: Any) -> Settings:
        """Return the parameters of a theory; those of the other theory may be given if they have their defaults.

        Raises:
            ValueError: as the classes, or if there is no such theory, or a parameter is of the other one.
        """
        if theory not in tuple(_SETTINGS):
            raise RequestError(f"theory: got {theory!r}, wanted one of {', '.join(THEORIES)}")
        if given.get("terms") == "auto":
            given["terms"] = None
        kind = _SETTINGS[theory]
        foreign = SPECTRUM_PARAMETERS.keys() - {field.name for field in fields(kind)}
        for name in sorted(foreign & given.keys()):
            if (value := given.pop(name)) != SPECTRUM_PARAMETERS[name].default:
                raise RequestError(f"{name}: got {value!r} with theory {theory!r}, {kind.refusal}")
        return kind(**given)

    def __post_init__(self) -> None:
        self._check("coherence_length", lambda x: lobe_width(x) > 0, "a number")
        if self.tolerance is not None:
            wanted = f"a fraction of the light, at least {self.min_tolerance:g} and below 1"
            self._check("tolerance", lambda x: self.min_tolerance <= x < self._tolerance_limit, wanted)
        self._check("largest_height_range", lambda x: x > 0, "a positive number of µm")
        try:
            shortest, longest = (float(w) for w in self.wavelengths)
        except (TypeError, ValueError, OverflowError):
            raise RequestError(f"wavelengths: got {self.wavelengths!r}, wanted (shortest, longest) in nm") from None
        if not MIN_WAVELENGTH <= shortest < longest < math.inf:
            raise RequestError(
                f"wavelengths: got {self.wavelengths!r}, wanted (shortest, longest) in nm, at least "
                f"{MIN_WAVELENGTH:g} nm"
            )
        object.__setattr__(self, "wavelengths", (shortest, longest))

    def _check(self, name: str, valid: Callable[[float], bool], wanted: str) -> None:
        """Raise RequestError unless a parameter is a valid number."""
        value = getattr(self, name)
        if not (is_number(value) and valid(value)):
            raise RequestError(f"{name}: got {value!r}, wanted {wanted}")

    def _check_known(self, name: str, known: tuple[str, ...]) -> None:
        """Raise RequestError unless a parameter is one of the known texts."""
        if (value := getattr(self, name)) not in known:
            raise RequestError(f"{name}: got {value!r}, wanted one of {', '.join(known)}")

    @property
    def _tolerance_limit(self) -> float:
        return 1.0

    @property
    def extent(self) -> str:
        """ "tile", or in scalar theory also "sample"."""
        return "tile"

    @property
    def chosen(self) -> dict[str, Any]:
        """The parameters that differ from the defaults, by name."""
        values = {name: getattr(self, name) for name in ("theory", *(f.name for f in fields(self)))}
        return {name: value for name, value in values.items() if value != SPECTRUM_PARAMETERS[name].default}


@dataclass(frozen=True, kw_only=True)
class ScalarSettings(Settings):
    """The parameters of a spectrum of scalar theory, beside those of `Settings`.

    Attributes:
        extent: "tile": the patch repeats periodically; "sample": it is a piece of a larger, irregular surface.
        largest_angle: largest angle of incidence and exit in the scene, degrees from the normal; below 90, fewer
            frequencies are kept.
        representation: "slices" (also chosen by "auto"): powers; or a series of the amplitudes of one tile, "taylor"
            (Stam 1999) or "chebyshev" (Dhillon and Ghosh 2016).
        terms: N of a series, whatever its error; None, in files "auto", is the number that the tolerance requires.
        heights_from: the level of h = 0 in a series: "mean" or "lowest".

    Raises:
        ValueError: if one is out of range, or they contradict each other.
    """

    theory: ClassVar[str] = "scalar"
    min_tolerance: ClassVar[float] = MIN_TOLERANCE
    refusal: ClassVar[str] = "wanted none: the spectrum holds for every material"

    extent: str = "tile"
    largest_angle: float = 90.0
    representation: str = "auto"
    terms: int | None = None
    heights_from: str = "mean"

    def __post_init__(self) -> None:
        self._check_known("extent", EXTENTS)
        self._check_known("representation", REPRESENTATIONS)
        self._check_known("heights_from", ORIGINS)
        super().__post_init__()
        self._check("largest_angle", lambda x: 0 < x <= 90, "degrees from the normal, above 0, at most 90")
        if self.representation not in SERIES:
            for name, value, default in (("terms", self.terms, None), ("heights_from", self.heights_from, "mean")):
                if value != default:
                    raise RequestError(
                        f"{name}: got {value!r} with representation {self.representation!r}, wanted it with a series, "
                        f"{' or '.join(SERIES)}"
                    )
        elif self.extent != "tile":
            raise RequestError(
                f"representation: got {self.representation!r} with extent {self.extent!r}, wanted 'slices': an average "
                "has no amplitude"
            )
        if self.terms is not None:
            check_whole("terms", self.terms, 1, MAX_TERMS)

    @property
    def _tolerance_limit(self) -> float:
        return math.inf if isinstance(self.terms, int) else 1.0

    @property
    def lobe_cutoff(self) -> float:
        """Half the side of the square to which a lobe is truncated, in σ_q, for the part of the tolerance that it has.

        The default stands for tolerances from one on.
        """
        assert self.tolerance is not None
        return lobe_cutoff(TAIL_FRACTION * (self.tolerance if self.tolerance < 1 else CONTINUUM_TOLERANCE))


@dataclass(frozen=True, kw_only=True)
class RigorousSettings(Settings):
    """The parameters of a table of rigorous theory, of a tile and for all directions, beside those of `Settings`.

    Attributes:
        int_ior: index of a dielectric, or n + ik; or a medium with dispersion, or a file.
        material: or a conductor by Mitsuba's name, a medium with dispersion, or a file (`refractive_indices.index_of`).
        ext_ior: index of the medium above relative to air, for a grating under a coat; wavelengths are measured in this
            medium.
        polarised: whether to store Mueller matrices for polarised variants; the table is then seventeen times as large.
        transmission: "interface" or "sheet" to include the light that a dielectric transmits.

    Raises:
        ValueError: if one is out of range, or they contradict each other.
    """

    theory: ClassVar[str] = "rigorous"
    min_tolerance: ClassVar[float] = MIN_RIGOROUS_TOLERANCE
    refusal: ClassVar[str] = "wanted none: its table is always that of a tile, for all directions"

    int_ior: complex | str | None = None
    material: str | None = None
    ext_ior: float = 1.0
    polarised: bool = False
    transmission: str = "none"

    def __post_init__(self) -> None:
        self._check_known("transmission", TRANSMISSIONS)
        super().__post_init__()
        self._check("ext_ior", lambda x: 1 <= x <= 10, "the index of the medium above, from 1 to 10")
        object.__setattr__(self, "ext_ior", float(self.ext_ior))
        if not isinstance(self.polarised, bool):
            raise RequestError(f"polarised: got {self.polarised!r}, wanted True or False")
        if self.transmission != "none":
            if self.int_ior is None or isinstance(self.int_ior, str) or np.imag(self.int_ior) != 0:
                raise RequestError(
                    f"transmission: got {self.transmission} with material {self.material!r} and int_ior "
                    f"{self.int_ior!r}, wanted a dielectric of one index, a number"
                )
            if self.ext_ior != 1:
                raise RequestError(
                    f"transmission: got {self.transmission} and ext_ior {self.ext_ior!r}, wanted no coat"
                )


_SETTINGS: dict[str, type[ScalarSettings] | type[RigorousSettings]] = {
    kind.theory: kind for kind in (ScalarSettings, RigorousSettings)
}
THEORIES = tuple(_SETTINGS)
SPECTRUM_PARAMETERS = {
    "theory": inspect.Parameter("theory", inspect.Parameter.KEYWORD_ONLY, default="scalar", annotation="str"),
    **{
        field.name: inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=field.type
        )
        for kind in _SETTINGS.values()
        for field in fields(kind)
    },
}
"""The parameters of both theories, with their defaults, as `precompute` takes them."""


def wavelengths_inside(index: float, scale: float = 1.0, outside: tuple[float, float] = VISIBLE) -> tuple[float, float]:
    """Return (shortest, longest) wavelengths of light in a medium, in nm: λ/n, the shortest divided by s.

    Args:
        index: n, the largest absolute index of the media beside the surface.
        scale: s, the largest factor of heights or lengths, which is equivalent to wavelengths that are shorter by s.
        outside: (shortest, longest) wavelengths in air.

    Raises:
        ValueError: if the shortest wavelength is below `MIN_WAVELENGTH`.
    """
    shortest, max_scale = outside[0] / (index * scale), outside[0] / (index * MIN_WAVELENGTH)
    if scale > max_scale:
        raise RequestError(f"height_scale, lateral_scale: got up to {scale:g}, wanted at most {max_scale:.3g}")
    return shortest, outside[1] / index


def lobe_width(coherence_length: float) -> float:
    """Return σ_q in cycles/µm for the coherence length L_c in µm.

    The window is Gaussian in amplitude, a(x) = exp(−|x|²/2σ_s²) with σ_s = L_c/4; the power of its transform is a
    Gaussian of standard deviation σ_q = 1/(2√2 π σ_s).

    Raises:
        ValueError: if the coherence length is not 1 nm to 1 m.
    """
    if not MIN_COHERENCE_LENGTH <= coherence_length <= MAX_COHERENCE_LENGTH:
        wanted = f"{MIN_COHERENCE_LENGTH:g} to {MAX_COHERENCE_LENGTH:g} µm"
        raise RequestError(f"coherence_length: got {coherence_length!r}, wanted {wanted}")
    return 1 / (2 * math.sqrt(2) * math.pi * (coherence_length / 4))


def lobe_cutoff(change: float) -> float:
    """Return half the side ρ of the square to which a lobe is truncated, in standard deviations.

    A two-dimensional Gaussian has the fraction 1 − erf(ρ/√2)² outside that square. Cutting the tails and rescaling
    changes the Gaussian by twice this fraction in the L1 norm. ρ is chosen so that this equals `change`.
    """
    # 1 − √(1 − change/2) without cancellation.
    return -NormalDist().inv_cdf(-math.expm1(0.5 * math.log1p(-change / 2)) / 2)


def matching(q: ArrayLike, kappa: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return q (..., 2) and κ (...) as float64 arrays, broadcast against each other."""
    q = np.asarray(q, np.float64)
    kappa = np.asarray(kappa, np.float64)
    if q.ndim == 0 or q.shape[-1] != 2:
        raise RequestError(f"q: got shape {q.shape}, wanted (..., 2) in cycles/µm")
    if not np.isfinite(q).all():
        raise RequestError("q: got numbers that are not finite, wanted cycles/µm")
    try:
        shape = np.broadcast_shapes(q.shape[:-1], kappa.shape)
    except ValueError:
        raise RequestError(
            f"kappa: got shape {kappa.shape}, which does not broadcast with q of shape {q.shape}"
        ) from None
    return np.broadcast_to(q, (*shape, 2)), np.broadcast_to(kappa, shape)
