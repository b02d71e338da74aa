"""The plate that is designed: its texels, its light, and the directions of the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import Real
from ..errors import RequestError, check_whole, is_number
from ..optics.refractive_indices import MAX_CLEAR_K, index_of
from ..settings import MIN_WAVELENGTH, VISIBLE
from .far_field import blurred_texels

_MAX_TEXELS = 256
_ORDERS_PER_STROKE = 3.0  # of the finest strokes of a picture; see the eye chart in docs/designed_reliefs.md
MIN_STROKES = 4 / _ORDERS_PER_STROKE  # of a plate whose period is two orders across half the picture
_MAX_ANGLE = 30.0  # degrees, that `for_detail` takes
_MAX_PATH = 16.0  # largest path difference in wavelengths; deeper reliefs are far outside of scalar theory
_HEIGHT_RANGE = 0.8  # µm, at least
_FACET_SPREAD = 0.886  # full width at half maximum of (sin x/x)², in λ/L
_MARGIN = 1.2  # of the wavelengths of invisible light, by which its spectrum covers more than the design


def for_detail(detail: float, texel: float, angle: float, wavelength: float) -> tuple[int, float]:
    """Return the number of texels, and the angle, that resolve strokes of 1/`detail` of the width of a picture.

    The angle is the given one, unless it takes a larger one for `_MAX_TEXELS` to suffice.

    Args:
        detail: number of the finest strokes along an edge of the picture.
        texel: µm.
        angle: degrees, from the mirror direction to the middle of an edge.
        wavelength: the longest, nm.

    Raises:
        ValueError: if no plate resolves them.
    """
    if not (is_number(detail) and detail >= 2):
        raise RequestError(f"detail: got {detail!r}, wanted the number of finest strokes along an edge, at least 2")
    orders = _ORDERS_PER_STROKE * detail * wavelength * 1e-3 / (2 * texel)  # times sin(angle): texels
    fitting = math.degrees(math.asin(min(orders / _MAX_TEXELS, 1)))
    if fitting > max(angle, _MAX_ANGLE):
        most = 2 * texel * _MAX_TEXELS * math.sin(math.radians(max(angle, _MAX_ANGLE)))
        raise RequestError(
            f"detail: got {detail:g}, wanted at most {int(most / (_ORDERS_PER_STROKE * wavelength * 1e-3))} strokes "
            f"along an edge with texels of {texel:g} µm at {wavelength:.0f} nm"
        )
    angle = max(angle, math.ceil(10 * fitting) / 10)
    return max(4, math.ceil(orders / math.sin(math.radians(angle)))), angle


def resolved_strokes(texels: int, texel: float, angle: float, wavelength: float) -> float:
    """Return how many of the finest strokes that a plate resolves fit along an edge; arguments as of `for_detail`."""
    return 2 * texels * texel * math.sin(math.radians(angle)) / (_ORDERS_PER_STROKE * wavelength * 1e-3)


def depth_for_strokes(strokes: float, wavelengths: ArrayLike, int_ior: float | str | None = None) -> float:
    """Return the height range in µm with which strokes of 1/`strokes` of an edge are sharp at the edge of the picture.

    Light of many wavelengths is directed by facets. One that directs it to the edge, at the direction cosine s, has a
    slope of s/p, with the path p per height, and L = h p/s fits into the height range h. Its light spreads by
    0.886 λ/L, which is a stroke, 2 s/`strokes`, at h = 0.443 λ strokes/p, whatever s. Light of one wavelength needs no
    more than the smallest height range, as steps of whole wavelengths continue its facets.

    Args:
        strokes: number of the finest strokes along an edge of the picture.
        wavelengths: nm.
        int_ior: index of a sheet, as of `Plate`.
    """
    light = np.atleast_1d(np.asarray(wavelengths, np.float64)) * 1e-3
    path = np.full(light.shape, 2.0) if int_ior is None else index_of("int_ior", int_ior)(light).real - 1
    if light.size == 1 or path.min() <= 0:
        return _HEIGHT_RANGE
    per_height = light / path
    depth = min(_FACET_SPREAD / 2 * strokes * float(per_height.mean()), _MAX_PATH * float(per_height.min()))
    # Also of what is not a number, which is refused later.
    return math.floor(10 * depth) / 10 if depth > _HEIGHT_RANGE else _HEIGHT_RANGE


@dataclass(frozen=True, eq=False)
class Plate:
    """A periodic relief of square texels, and its light; the arguments of `design`.

    Raises:
        ValueError: if one is out of range, or the texels cannot direct light to the edges of the picture.
    """

    texel: float
    texels: int
    height_range: float
    angle: float
    wavelengths: Real
    int_ior: float | str | None
    levels: int | None
    tool_blur: float
    seen_on: str = "wall"
    unused: str = "outside"

    def __post_init__(self) -> None:
        for name, zero in (("texel", False), ("height_range", False), ("tool_blur", True)):
            value = getattr(self, name)
            if not is_number(value) or value < 0 or (value == 0 and not zero):
                wanted = "0 µm or more" if zero else "a positive number of µm"
                raise RequestError(f"{name}: got {value!r}, wanted {wanted}")
        check_whole("texels", self.texels, 4, _MAX_TEXELS)
        if not (is_number(self.angle) and 0 < self.angle < 45):
            raise RequestError(
                f"angle: got {self.angle!r}, wanted degrees above 0 and below 45, where the corners of the picture are "
                "at the horizon"
            )
        if self.int_ior is not None:
            medium = index_of("int_ior", self.int_ior)
            medium.known_range("int_ior").check((float(self.wavelengths.min()), float(self.wavelengths.max())))
            n = medium(self.wavelengths * 1e-3)
            if n.imag.max() > MAX_CLEAR_K or not (1 < n.real.min() <= n.real.max() <= 10):
                raise RequestError(f"int_ior: got {self.int_ior!r}, wanted an index above 1, or none for a mirror")
        if self.levels is not None:
            check_whole("levels", self.levels, 2)
        if self.tool_blur > self.period / 8:
            raise RequestError(
                f"tool_blur: got {self.tool_blur:g} µm, wanted at most an eighth of the period, {self.period / 8:.3g} "
                "µm: a wider tool makes a flat plate"
            )
        deepest = self.height_range * _MAX_PATH / self.path
        if self.height_range > deepest:
            raise RequestError(
                f"height_range: got {self.height_range:g} µm, a path difference of {self.path:.3g} wavelengths; wanted "
                f"at most {deepest:.3g} µm, {_MAX_PATH:g} wavelengths"
            )
        for name, known in (("seen_on", ("wall", "screen")), ("unused", ("outside", "mirror"))):
            if getattr(self, name) not in known:
                raise RequestError(f"{name}: got {getattr(self, name)!r}, wanted {' or '.join(known)}")
        longest = float(self.wavelengths.max()) * 1e-3
        sine = math.sin(math.radians(self.angle))
        if self.texel <= longest / 2:
            raise RequestError(
                f"texel: got {self.texel:g} µm, wanted more than half the wavelength, {longest / 2:.3g} µm: the first "
                "order of texels that alternate would be evanescent"
            )
        if self.texel >= longest / sine:
            raise RequestError(
                f"texel: got {self.texel:g} µm with an angle of {self.angle:g}°, wanted less than {longest / sine:.3g} "
                "µm (λ/sin angle): a flat texel sends no light further out"
            )
        if self.period * sine < 2 * longest:
            raise RequestError(
                f"texels: got {self.texels} of {self.texel:g} µm with an angle of {self.angle:g}°, wanted a period of "
                f"at least {2 * longest / sine:.3g} µm (2 λ/sin angle), or a larger angle: orders are "
                f"{longest / self.period:.2g} apart, the picture ends at {sine:.2g}"
            )

    @property
    def period(self) -> float:
        """T in µm."""
        return self.texel * self.texels

    @property
    def mirrored(self) -> bool:
        """Whether the right of the picture, as it is seen, is −x of ω_o.

        An eye that looks the way the light goes, onto a wall, has −x of reflected light at its right, and +x of light
        that a sheet transmits. An eye that looks towards the plate, at a screen, has the opposite.
        """
        return (self.seen_on == "wall") == (self.int_ior is None)

    @property
    def coherence_length(self) -> float:
        """Half the period, in µm: the lobe of an order has a standard deviation of 0.9/T, so that orders merge."""
        return self.period / 2

    @property
    def pitch(self) -> float:
        """The largest distance of adjacent orders, λ/T, in direction cosines."""
        return float(self.wavelengths.max()) * 1e-3 / self.period

    @property
    def orders_across(self) -> float:
        """Orders of the shortest wavelength along an edge of the picture."""
        return 2 * math.sin(math.radians(self.angle)) * self.period / (float(self.wavelengths.min()) * 1e-3)

    @property
    def kappa(self) -> Real:
        """κ in rad/µm of each wavelength, (w,), halfway between the middle of the picture and its edge.

        2π (1 + cos θ)/λ. For a sheet whose relief the light meets first, 2π (1 − √(n² − sin² θ))/λ, which is negative.
        """
        sine = math.sin(math.radians(self.angle)) / 2
        wavelengths = self.wavelengths * 1e-3
        path = (
            1 + math.sqrt(1 - sine**2) if self.int_ior is None else 1 - np.sqrt(self.index(wavelengths) ** 2 - sine**2)
        )
        return 2 * np.pi * path / (self.wavelengths * 1e-3)

    def index(self, wavelengths: ArrayLike) -> Real:
        """Return n of a sheet at wavelengths in µm."""
        assert self.int_ior is not None
        return index_of("int_ior", self.int_ior)(wavelengths).real

    @property
    def path(self) -> float:
        """The path difference between the lowest and the highest texel, in wavelengths, at most."""
        return float(np.abs(self.kappa).max()) * self.height_range / (2 * np.pi)

    @property
    def light(self) -> tuple[float, float]:
        """(shortest, longest) wavelengths, nm, for which relief and spectrum are made: visible light, unless others."""
        shortest, longest = float(self.wavelengths.min()), float(self.wavelengths.max())
        if shortest >= VISIBLE[0] and longest <= VISIBLE[1]:
            return VISIBLE
        shortest, longest = max(shortest / _MARGIN, MIN_WAVELENGTH), longest * _MARGIN
        if longest < VISIBLE[0] or shortest > VISIBLE[1]:
            return shortest, longest
        return min(shortest, VISIBLE[0]), max(longest, VISIBLE[1])

    def edges(self, bins: int) -> Real:
        """Return the edges of bins of equal width across the picture, in direction cosines, (bins + 1,)."""
        return np.linspace(-1, 1, bins + 1) * math.sin(math.radians(self.angle))

    def spread(self, per_texel: int, blur_scale: float = 1.0) -> Real:
        """Return U of `blurred_texels` for this plate, with a blur of the tool that is larger by a factor."""
        return blurred_texels(self.texels, per_texel, blur_scale * self.tool_blur / self.texel)
