"""The range of scalar theory: the deviation of its efficiencies from rigorous ones.

A stored map quantifies it for sinusoids, over period/λ and depth/λ, by the solver of `rigorous`
(`tools/data/scalar_theory_map.py`). Profiles to which rigorous theory applies are solved instead.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..array_types import Real
from ..errors import RequestError
from ..optics.media import MediumBelow
from ..rigorous.coordinate_transformation import curve_of, is_profile
from ..rigorous.rigorous_spectrum import MAX_PERIOD_IN_WAVELENGTHS
from ..rigorous.solver import converge
from ..settings import VISIBLE
from ..surface.heightfield import HeightField
from ..surface.periods import powers_of_heights
from .closed_form import efficiency_difference, profile_powers, scalar_orders, transmitted_orders

MAP = Path(__file__).parents[1] / "data" / "scalar_error.json"

# Conditions under which the error of a surface is reported; the map is the same for ±20°.
INDEX = 1.5
ERROR_ANGLES = (0.0, 20.0, -20.0)  # of incidence, degrees
ERROR_WAVELENGTHS = (0.45, 0.55, 0.65)  # µm, of visible light
_PARTS = (1 / 6, 1 / 2, 5 / 6)  # of another range of wavelengths: the middles of its thirds
_MIN_POWER = 1e-9  # of a wave, as a fraction of all
_WAVES_PER_OCTAVE = 16  # of period, into which the waves of a surface are sorted

MAX_TRUSTED_ERROR = 0.1  # above which a surface is considered outside the range of scalar theory
# R.m.s. factor between the estimated error, from the map, and the solved error of 48 profiles; docs/validation.md.
ESTIMATE_FACTOR = 1.4
_MAX_SOLVER_ERROR = 1e-2
_MAX_ACROSS = 1e-3  # of the variance of slopes along lines, relative to that across them, for a line grating


def equivalent_depth(rms_height: float) -> float:
    """Return the peak-to-valley depth of the sinusoid of equal r.m.s. height, 2√2 times that (any unit)."""
    return 2 * np.sqrt(2) * rms_height


@functools.cache
def error_map(case: str = "dielectric") -> tuple[Real, Real, Real, Real]:
    """Return the error of scalar theory for sinusoids in unpolarised light (`tools/data/scalar_theory_map.py`).

    Args:
        case: "dielectric", n = 1.5, or "Al", aluminium at 550 nm; "transmitted" and "transmitted from below": the
            transmission of the dielectric, with directions in air.

    Returns:
        period/λ (n,), depth/λ (k,), directions (a, 2) in degrees, and the error, (n, k, a). Directions are the angle of
        incidence and the azimuth of its plane, 0 if perpendicular to the grooves.
    """
    content = json.loads(MAP.read_text(encoding="utf-8"))
    if case not in content["error"]:
        raise RequestError(f"case: got {case!r}, wanted one of {', '.join(content['error'])}")
    periods, depths, directions = (np.array(content[name], float) for name in ("periods", "depths", "directions"))
    errors = np.reshape(content["error"][case], (len(directions), len(depths), len(periods)))
    return periods, depths, directions, errors.transpose(2, 1, 0)


@functools.cache
def _logarithms(case: str, largest_angle: float, mean: bool) -> tuple[Real, Real, Real]:
    """Return ln(period/λ) (n,), ln(depth/λ) (k,), and the logarithm of the error over directions, (k, n)."""
    periods, depths, directions, errors = error_map(case)
    errors = errors[..., directions[:, 0] <= largest_angle]
    error = errors.mean(axis=2) if mean else errors.max(axis=2)
    return np.log(periods), np.log(depths), np.log(np.maximum(error.T, 1e-6))


def expected_error(
    period: float,
    depth: float,
    wavelength: float,
    *,
    case: str = "dielectric",
    largest_angle: float = 20.0,
    mean: bool = False,
) -> float:
    """Return the expected error of scalar theory for a surface at incidence up to some angle.

    The largest of the stored errors at 0°, 20°, 40° and 60° up to `largest_angle`, including conical incidence at 40°
    and 60°, interpolated linearly in the logarithms. The stored errors were computed for sinusoids. Other surfaces are
    represented by their main period and their `equivalent_depth`; edges increase the error.

    Args:
        period: µm.
        depth: peak to valley, µm.
        wavelength: µm.
        case: see `error_map`.
        largest_angle: degrees.
        mean: of these errors instead of the largest.

    Returns:
        Σ|Δη_m| relative to the reflected, or transmitted, power. Above the largest stored period (20 λ) and below the
        smallest depth (λ/20), the value at the boundary, an upper bound. NaN for periods below λ or depths above 2 λ,
        which are not stored and outside the range of scalar theory.

    Raises:
        ValueError: unless period and wavelength are positive and the depth is not negative, or for another case.
    """
    for name, value in (("period", period), ("wavelength", wavelength)):
        if not (np.isfinite(value) and value > 0):
            raise RequestError(f"{name}: got {value!r}, wanted a positive number in µm")
    if not (np.isfinite(depth) and depth >= 0):
        raise RequestError(f"depth: got {depth!r}, wanted a number in µm, zero or more")
    if not largest_angle >= 0:
        raise RequestError(f"largest_angle: got {largest_angle!r}, wanted degrees, zero or more")
    periods, depths, _, _ = error_map(case)
    if period < periods[0] * wavelength or depth > depths[-1] * wavelength:
        return float("nan")
    # Outside, `np.interp` takes the value at the boundary.
    at, across, errors = _logarithms(case, float(largest_angle), mean)
    of_depths = [np.interp(np.log(period / wavelength), at, error) for error in errors]
    return float(np.exp(np.interp(np.log(max(depth / wavelength, depths[0])), across, of_depths)))


@dataclass(frozen=True)
class ScalarError:
    """The error of scalar theory for one surface: the mean over `ERROR_ANGLES` and some wavelengths.

    Attributes:
        reflected: Σ|Δη_m| as a fraction of the reflected power; infinite outside the stored map (depths above 2 λ).
        transmitted: the same for transmitted light; None below a medium that absorbs it.
        estimated: whether it is from the stored map, within about `ESTIMATE_FACTOR`, instead of solved for the surface.
        remedy: the alternative to scalar theory for this surface.
        wavelengths: of which it is the mean, in air, µm.
        medium: below the surface, for which it holds.
    """

    reflected: float
    transmitted: float | None
    estimated: bool
    remedy: str
    wavelengths: tuple[float, ...]
    medium: str = f"n = {INDEX:g}"

    @property
    def bound(self) -> float:
        """The error above which the surface is outside the range of scalar theory."""
        return MAX_TRUSTED_ERROR * (ESTIMATE_FACTOR if self.estimated else 1)

    @property
    def warning(self) -> str:
        """A sentence if the error exceeds the bound, otherwise ""."""
        return f"scalar theory: {self}; {self.remedy}" if self.reflected > self.bound else ""

    def __str__(self) -> str:
        first, last = (f"{1e3 * wavelength:.0f}" for wavelength in (self.wavelengths[0], self.wavelengths[-1]))
        light = f"{first} nm" if first == last else f"{first}–{last} nm"
        if not np.isfinite(self.reflected):
            return f"error unknown, the surface is deeper than two wavelengths ({light})"
        about = "about " if self.estimated else ""
        errors = ((self.reflected, "reflected light"), (self.transmitted, "transmitted"))
        parts = [
            f"{float(f'{100 * error:.2g}'):g}% of the {of_light}" for error, of_light in errors if error is not None
        ]
        conditions = f"mean over {light} and 0–{max(ERROR_ANGLES):g}°, {self.medium}"
        return f"errs by {about}{', '.join(parts)} ({conditions})"


@dataclass(frozen=True)
class Waves:
    """The waves in the heights of a surface, from which the error of scalar theory is estimated for any light.

    Attributes:
        depth: of the sinusoid of equal roughness, µm.
        periods: µm, (n,).
        power: the fraction of the variance of each, (n,).
        width: of a profile along x, to which rigorous theory applies, µm; None of other surfaces.
        solved: the error of such a profile on n = 1.5, solved for one light.
        turned: angle from y to the lines of a surface that varies along one other direction alone, degrees; else 0.
    """

    depth: float
    periods: tuple[float, ...]
    power: tuple[float, ...]
    width: float | None = None
    solved: ScalarError | None = None
    turned: float = 0.0

    @classmethod
    def of(cls, height_field: HeightField, extent: str) -> Waves:
        """Determine the waves of a surface; a "sample" is levelled first."""
        frequencies, power, rms_height = powers_of_heights(height_field, extent)
        kept = power > _MIN_POWER * power.sum()
        steps = np.rint(_WAVES_PER_OCTAVE * np.log2(1 / np.maximum(frequencies[kept], 1e-12)))
        found, where = np.unique(steps, return_inverse=True)
        sums = np.bincount(where, power[kept]) / max(power.sum(), 1e-300)
        periods = 2 ** (found / _WAVES_PER_OCTAVE)
        width = height_field.tile_size[0] if extent == "tile" and is_profile(height_field) else None
        turned = _turned(height_field) if width is None and min(height_field.shape) > 1 else 0.0
        return cls(
            float(equivalent_depth(rms_height)), tuple(periods.tolist()), tuple(sums.tolist()), width, turned=turned
        )

    def error(
        self, light: tuple[float, float] = VISIBLE, index: float = 1.0, *, transparent: bool = True
    ) -> ScalarError:
        """Return the error in light of (shortest, longest) wavelengths, nm, in a medium of an index above the surface.

        The map is averaged over the waves, each weighted by its fraction of the variance, at the depth of the sinusoid
        of equal roughness. Periods outside the map take the value at its boundary. Below the surface is n = 1.5, or,
        unless `transparent`, aluminium, which stands for all metals.
        """
        wavelengths = error_wavelengths(light)
        if self.solved is not None and self.solved.wavelengths == wavelengths and index == 1 and transparent:
            return self.solved
        inside, remedy = [wavelength / index for wavelength in wavelengths], self.remedy(light[0] * 1e-3 / index)
        if not transparent:
            return ScalarError(self._estimated("Al", inside), None, True, remedy, wavelengths, "aluminium")
        reflected, transmitted = (self._estimated(name, inside) for name in ("dielectric", "transmitted"))
        return ScalarError(reflected, transmitted, True, remedy, wavelengths)

    def _estimated(self, case: str, wavelengths: Sequence[float]) -> float:
        """Return the mean error over wavelengths in µm; infinite for too large a depth."""
        if self.depth == 0:
            return 0.0
        nodes, total = error_map()[0], 0.0
        for wavelength in wavelengths:
            depth = self.depth / wavelength
            errors = [expected_error(node, depth, 1.0, case=case, mean=True) for node in nodes]
            if not np.isfinite(errors).all():
                return float("inf")
            of_waves = np.interp(np.log(np.divide(self.periods, wavelength)), np.log(nodes), np.log(errors))
            total += float(np.exp(of_waves) @ self.power)
        return total / len(wavelengths)

    def remedy(self, shortest: float) -> str:
        """Return the alternative to scalar theory for wavelengths from `shortest`, µm."""
        max_period = MAX_PERIOD_IN_WAVELENGTHS * shortest
        if self.turned:
            return f"its lines run at {self.turned:.3g}° from y; for lines along y (`rotate`) there is rigorous theory"
        if self.width is None:
            return "no rigorous theory is offered for a surface that varies along x and y"
        if self.width > max_period:
            return f"scenes have rigorous theory for periods of up to {max_period:.2g} µm, `efficiency` for longer ones"
        return "theory=rigorous has it right"

    def as_plain(self) -> dict[str, Any]:
        """Return the waves as JSON types."""
        return asdict(self)

    @classmethod
    def from_plain(cls, content: dict[str, Any]) -> Waves:
        """Return the waves that `as_plain` wrote."""
        content = {name: tuple(value) if isinstance(value, list) else value for name, value in content.items()}
        if (solved := content.pop("solved")) is not None:
            solved = ScalarError(**{**solved, "wavelengths": tuple(solved["wavelengths"])})
        return cls(**content, solved=solved)


def error_wavelengths(light: tuple[float, float]) -> tuple[float, ...]:
    """Return the wavelengths in µm at which the error is determined for light of (shortest, longest) ones in nm."""
    first, last = light
    if (first, last) == VISIBLE:
        return ERROR_WAVELENGTHS
    return tuple(sorted({1e-3 * (first + (last - first) * part) for part in _PARTS}))


def scalar_waves(height_field: HeightField, extent: str = "tile", light: tuple[float, float] = VISIBLE) -> Waves:
    """Determine the waves of a surface, and solve profiles to which rigorous theory applies for the light in nm."""
    waves = Waves.of(height_field, extent)
    return replace(waves, solved=_solved(height_field, waves, light, MediumBelow.of()))


def scalar_error(
    height_field: HeightField,
    extent: str = "tile",
    light: tuple[float, float] = VISIBLE,
    below: MediumBelow | None = None,
) -> ScalarError:
    """Determine the error of scalar theory for a surface; a "sample" is levelled first.

    Periodic profiles to which rigorous theory applies are solved, on the medium below. For any other surface, and the
    perfect mirror, it is estimated (`Waves`).

    Args:
        height_field: the surface.
        extent: "tile" or "sample".
        light: (shortest, longest) wavelengths, nm.
        below: the medium below; n = 1.5 of none.
    """
    waves, below = Waves.of(height_field, extent), below or MediumBelow.of()
    solved = _solved(height_field, waves, light, below)
    return solved or waves.error(light, transparent=below.transparent)


def _turned(height_field: HeightField) -> float:
    """Return the angle from y to lines of equal height, degrees; 0 unless gradients have one direction."""
    slopes = [slope.ravel() for slope in reversed(np.gradient(height_field.centred, *height_field.pixel_size[::-1]))]
    (across, along), directions = np.linalg.eigh(np.cov(slopes))
    if across > _MAX_ACROSS * along:
        return 0.0
    x, y = directions[:, 1]
    return float(np.degrees(np.arctan2(y, x)) % 180)


def _solved(
    height_field: HeightField, waves: Waves, light: tuple[float, float], below: MediumBelow
) -> ScalarError | None:
    """Solve a profile to which rigorous theory applies; None of any other surface, and unless the solver converges."""
    wavelengths = error_wavelengths(light)
    if waves.width is None or waves.width > MAX_PERIOD_IN_WAVELENGTHS * light[0] * 1e-3 or below.index is None:
        return None
    # Deeper profiles take long to solve, and are far outside the range.
    if waves.depth > wavelengths[0]:
        return None
    reflected = transmitted = 0.0
    if waves.depth > 0:
        row, indices = tuple(height_field.heights[0].tolist()), tuple(below.index_at(length) for length in wavelengths)
        reflected, transmitted = _solved_error(row, height_field.pixel_size, wavelengths, ERROR_ANGLES, indices)
    if not np.isfinite(reflected):
        return None
    remedy, through = waves.remedy(light[0] * 1e-3), transmitted if below.transparent else None
    return ScalarError(reflected, through, False, remedy, wavelengths, str(below))


@functools.lru_cache(maxsize=64)
def _solved_error(
    heights: tuple[float, ...],
    pixel_size: tuple[float, float],
    wavelengths: tuple[float, ...],
    angles: tuple[float, ...],
    indices: tuple[complex, ...],
) -> tuple[float, float]:
    """Compute the mean error of reflected and of transmitted light; NaN if the solver does not converge.

    Below the profile is a medium of an index for each wavelength; one that absorbs transmits nothing.

    One profile has several spectra, such as those of a study of convergence.
    """
    profile = HeightField(np.array([heights]), pixel_size)
    period, powers, curve = profile.tile_size[0], profile_powers(profile), curve_of(profile)
    errors = []
    for wavelength, index in zip(wavelengths, indices, strict=True):
        for angle in angles:
            omega_i = np.array([-np.sin(np.deg2rad(angle)), 0.0, np.cos(np.deg2rad(angle))])
            exact = converge(curve, omega_i, period / wavelength, index, _MAX_SOLVER_ERROR)
            if not exact.error <= _MAX_SOLVER_ERROR:
                return float("nan"), float("nan")
            pairs = [(scalar_orders(powers, period, wavelength, angle, index), exact.reflection)]
            if index.imag == 0:
                pairs.append((transmitted_orders(powers, period, wavelength, angle, index.real), exact.transmission))
            # Only one of the theories may include an order exactly at the horizon, which has no power.
            errors.append(
                [
                    efficiency_difference(
                        one.unpolarised[np.isin(one.m, two.m)], two.unpolarised[np.isin(two.m, one.m)]
                    )
                    for one, two in pairs
                ]
            )
    mean = np.mean(errors, axis=0)
    return float(mean[0]), float(mean[-1])
