"""The range of scalar theory: its efficiencies in closed form, and their deviation from rigorous ones.

Scalar theory treats each facet of the surface as a plane mirror (tangent-plane approximation), which holds if the
surface varies slowly on the scale of a wavelength. A stored map quantifies its error over period/λ and depth/λ, by the
solver of `rigorous` (`tools/data/scalar_theory_map.py`).
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.special import jv

from .errors import RequestError
from .geometry import Diffracted, diffracted, fresnel
from .reference import amplitudes
from .rigorous.coordinate_transformation import curve_of, is_profile
from .rigorous.rigorous_spectrum import MAX_PERIOD_IN_WAVELENGTHS
from .rigorous.solver import converge
from .settings import VISIBLE
from .spectrum.grids import OrderGrid
from .surface.heightfield import HeightField
from .surface.periods import height_spectrum

Array = NDArray[np.float64]
OrderPowers = Callable[[NDArray[np.int64], Array], Array]
"""(m, κ), broadcast against each other → η_m(κ)."""

MAP = Path(__file__).parent / "data" / "scalar_error.json"

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


def incident_direction(angle: float, azimuth: float) -> Array:
    """Return ω_i, (3,), from the angle of incidence and the azimuth of its plane in degrees."""
    theta, phi = np.deg2rad((angle, azimuth))
    return np.array([-np.sin(theta) * np.cos(phi), -np.sin(theta) * np.sin(phi), np.cos(theta)])


def equivalent_depth(rms_height: float) -> float:
    """Return the peak-to-valley depth of the sinusoid of equal r.m.s. height, 2√2 times that (any unit)."""
    return 2 * np.sqrt(2) * rms_height


def sinusoid_powers(depth: float) -> OrderPowers:
    """Return η_m = J_m(κ · depth / 2)² of a sinusoid; peak-to-valley depth in µm."""
    return lambda m, kappa: jv(m, kappa * depth / 2) ** 2


def profile_powers(height_field: HeightField) -> OrderPowers:
    """Compute η_m of a profile of one row, by direct summation for each pair (m, κ)."""
    if height_field.shape[0] != 1:
        raise RequestError(f"height_field: got {height_field.shape[0]} rows, wanted a profile of one")
    heights, count = height_field.centred[0], height_field.shape[1]

    def powers(m: NDArray[np.int64], kappa: Array) -> Array:
        m, kappa = np.broadcast_arrays(m, kappa)
        waves = np.exp(1j * (kappa[..., None] * heights - 2 * np.pi * m[..., None] * np.arange(count) / count))
        return np.where(2 * np.abs(m) < count, np.abs(waves.mean(axis=-1)) ** 2, 0.0)

    return powers


def tile_powers(height_field: HeightField, shortest: float) -> OrderPowers:
    """Compute η_m of a tile, for pairs of m = (m_x, m_y), (…, 2), and κ up to 4π/`shortest`, a wavelength in µm.

    F_m(κ) is interpolated by Chebyshev polynomials in κ, exactly in float64: e^{iκh} oscillates no faster than e^{iκH},
    so that coefficients of orders above κH/2 decrease faster than exponentially.
    """
    max_kappa = 4 * np.pi / shortest
    degree = int(np.ceil(max_kappa * height_field.half_range / 2)) + 25
    grid = OrderGrid.reachable(height_field.tile_size, height_field.shape[::-1], 2 / shortest)
    m_x, m_y = (axis.ravel() for axis in np.meshgrid(*grid.axes()))

    def of_nodes(x: Array) -> Any:
        return np.stack([amplitudes(height_field, kappa)[m_y, m_x] for kappa in max_kappa / 2 * (x + 1)])

    coefficients: Any = chebyshev.chebinterpolate(of_nodes, degree)

    def powers(m: NDArray[np.int64], kappa: Array) -> Array:
        inside = np.asarray((np.abs(m) <= grid.max_order).all(axis=-1))
        columns, rows = np.moveaxis(np.where(inside[..., None], m + grid.max_order, 0), -1, 0)
        waves = chebyshev.chebvander(2 * kappa / max_kappa - 1, degree)
        amplitude = (waves * np.moveaxis(coefficients[:, rows * grid.shape[1] + columns], 0, -1)).sum(axis=-1)
        # Orders at the Nyquist frequency have no sign.
        inside &= (2 * np.abs(m) < height_field.shape[::-1]).all(axis=-1)
        return np.where(inside, np.abs(amplitude) ** 2, 0.0)

    return powers


@dataclass(frozen=True)
class Orders:
    """Efficiencies of the propagating orders of a grating.

    Attributes:
        m: the orders, (n,), of a tile (n, 2).
        s, p: fraction of the incident power in each, polarised perpendicular and parallel to the plane of incidence,
            (n,).
    """

    m: NDArray[np.int64]
    s: Array
    p: Array

    @property
    def unpolarised(self) -> Array:
        """The mean of s and p."""
        return (self.s + self.p) / 2


def scalar_orders(
    powers: OrderPowers,
    period: float | tuple[float, float],
    wavelength: float,
    angle: float,
    index: complex,
    azimuth: float = 0.0,
) -> Orders:
    """Compute R K G E η_m(κ_m), the efficiencies of the BSDF in float64 in the limit of narrow lobes.

    Integrating the BRDF R K G S(q; κ)/λ² E (`bsdf/`) times cos θ_o over the lobe of an order, with du dv = λ² dq, gives
    these factors at the direction of the order.

    Args:
        powers: of the profile or tile.
        period: µm; for a tile, along x and y.
        wavelength: µm.
        angle: of incidence, degrees, from −x.
        index: n + ik of the material; ∞ of a perfect mirror.
        azimuth: of the plane of incidence, degrees; 0: perpendicular to the grooves, 90: parallel (conical).
    """
    m, steps = _lattice(wavelength / np.atleast_1d(period), 2.0)

    def of_orders(kept: NDArray[np.bool_], kappa: Array) -> Array:
        return powers(m[kept], kappa)

    found, power = mirrored(of_orders, incident_direction(angle, azimuth)[:2], steps, wavelength)
    albedo = [mirrored(of_orders, tangent, steps, wavelength)[1].sum() for tangent in found.tangent]
    power = power / np.maximum(1, np.maximum(power.sum(), albedo))
    s, p = fresnel(found.cos_half, index)
    return Orders(m[found.kept], s * power, p * power)


def mirrored(
    powers: Callable[[NDArray[np.bool_], Array], NDArray[np.floating]], tangent: Array, steps: Array, wavelength: float
) -> tuple[Diffracted, Array]:
    """Return the directions of diffracted light, (n,), and K G S there, which a perfect mirror reflects without E.

    Args:
        powers: (mask of the frequencies that propagate, their κ) → S, or η_m.
        tangent: the tangential part of ω_i, (2,); nothing is reflected if it is evanescent.
        steps: λq, (..., 2).
        wavelength: λ, µm.
    """
    found = diffracted(tangent, steps)
    return found, found.k_g * powers(found.kept, 2 * np.pi * found.v_z / wavelength)


def transmitted_orders(
    powers: OrderPowers,
    period: float | tuple[float, float],
    wavelength: float,
    angle: float,
    index: float,
    azimuth: float = 0.0,
    from_below: bool = False,
    sheet: bool = False,
) -> Orders:
    """Compute K_t G_t (1 − F) η_m(κ_m), the transmitted orders of the BSDF in the limit of narrow lobes.

    For arguments see `scalar_orders`; the medium is a dielectric. The angle is measured in air. For light from below it
    is the angle of the direction into which a plane would refract the light. The efficiencies sum to at most one. For a
    sheet, with light from above, they include the transmittance 1 − F of the flat face.
    """
    n_i, n_o, side = (index, 1.0, -1) if from_below else (1.0, index, 1)
    m, steps = _lattice(wavelength / np.atleast_1d(period), n_i + n_o)
    found = diffracted(incident_direction(angle, azimuth)[:2], steps, n_i, n_o)
    # S(q; −κ) = S(−q; κ)
    kappa, sign = 2 * np.pi * np.abs(found.v_z) / wavelength, np.where(side * found.v_z < 0, -1, 1)
    m = m[found.kept]
    power = found.k_g * powers((m.T * sign).T, kappa)
    s, p = (power * (1 - reflected) for reflected in fresnel(found.cos_half, n_o / n_i))
    s, p = (polarised / max(1.0, (s + p).sum() / 2) for polarised in (s, p))
    if sheet:
        cos_out = np.sqrt(np.maximum(1 - n_o**2 + found.k_oz**2, 0))
        through = 1 - np.mean(fresnel(cos_out, index), axis=0)
        m, s, p = ((values.T * factor).T[cos_out > 0] for values, factor in ((m, 1), (s, through), (p, through)))
    return Orders(m, s, p)


def _lattice(pitch: Array, cutoff: float) -> tuple[NDArray[np.int64], Array]:
    """Return m up to |m| λ/T = `cutoff`, (n,) of a profile or (n, 2), and m λ/T along x and y, (n, 2)."""
    axes = [np.arange(-int(cutoff / p) - 1, int(cutoff / p) + 2) for p in pitch]
    m = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    m = m.reshape(-1, len(pitch))
    steps = np.zeros((len(m), 2))
    steps[:, : len(pitch)] = m * pitch
    return m if len(pitch) == 2 else m[:, 0], steps


def efficiency_difference(scalar: ArrayLike, rigorous: ArrayLike) -> float:
    """Return the L1 difference of efficiencies relative to the rigorously reflected power: Σ|Δη_m| / Σ η_m."""
    scalar, rigorous = np.asarray(scalar), np.asarray(rigorous)
    return float(np.abs(scalar - rigorous).sum() / rigorous.sum())


@functools.cache
def error_map(material: str = "dielectric") -> tuple[Array, Array, Array, Array]:
    """Return the error of scalar theory for sinusoids in unpolarised light (`tools/data/scalar_theory_map.py`).

    Args:
        material: "dielectric", n = 1.5, or "Al", aluminium at 550 nm; "transmitted" and "transmitted from below": the
            transmission of the dielectric, with directions in air.

    Returns:
        period/λ (n,), depth/λ (k,), directions (a, 2) in degrees, and the error, (n, k, a). Directions are the angle of
        incidence and the azimuth of its plane, 0 if perpendicular to the grooves.
    """
    content = json.loads(MAP.read_text(encoding="utf-8"))
    if material not in content["error"]:
        raise RequestError(f"material: got {material!r}, wanted one of {', '.join(content['error'])}")
    periods, depths, directions = (np.array(content[name], float) for name in ("periods", "depths", "directions"))
    errors = np.reshape(content["error"][material], (len(directions), len(depths), len(periods)))
    return periods, depths, directions, errors.transpose(2, 1, 0)


@functools.cache
def _interpolated(material: str, largest_angle: float, mean: bool) -> RegularGridInterpolator:
    periods, depths, directions, errors = error_map(material)
    errors = errors[..., directions[:, 0] <= largest_angle]
    error = errors.mean(axis=2) if mean else errors.max(axis=2)
    return RegularGridInterpolator((np.log(periods), np.log(depths)), np.log(np.maximum(error, 1e-6)))


def expected_error(
    period: float,
    depth: float,
    wavelength: float,
    *,
    material: str = "dielectric",
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
        material: see `error_map`.
        largest_angle: degrees.
        mean: of these errors instead of the largest.

    Returns:
        Σ|Δη_m| relative to the reflected, or transmitted, power. Above the largest stored period (20 λ) and below the
        smallest depth (λ/20), the value at the boundary, an upper bound. NaN for periods below λ or depths above 2 λ,
        which are not stored and outside the range of scalar theory.

    Raises:
        ValueError: unless period and wavelength are positive and the depth is not negative, or for another material.
    """
    for name, value in (("period", period), ("wavelength", wavelength)):
        if not (np.isfinite(value) and value > 0):
            raise RequestError(f"{name}: got {value!r}, wanted a positive number in µm")
    if not (np.isfinite(depth) and depth >= 0):
        raise RequestError(f"depth: got {depth!r}, wanted a number in µm, zero or more")
    if not largest_angle >= 0:
        raise RequestError(f"largest_angle: got {largest_angle!r}, wanted degrees, zero or more")
    periods, depths, _, _ = error_map(material)
    if period < periods[0] * wavelength or depth > depths[-1] * wavelength:
        return float("nan")
    point = np.minimum(period / wavelength, periods[-1]), np.maximum(depth / wavelength, depths[0])
    return float(np.exp(_interpolated(material, float(largest_angle), mean)(np.log(point))).item())


@dataclass(frozen=True)
class ScalarError:
    """The error of scalar theory for one surface: the mean over `ERROR_ANGLES` and some wavelengths, for n = 1.5.

    Attributes:
        share: Σ|Δη_m| as a fraction of the reflected power; infinite outside the stored map (depths above 2 λ).
        transmitted: the same for transmitted light.
        estimated: whether it is from the stored map, within about `ESTIMATE_FACTOR`, instead of solved for the surface.
        remedy: the alternative to scalar theory for this surface.
        wavelengths: of which it is the mean, in air, µm.
    """

    share: float
    transmitted: float
    estimated: bool
    remedy: str
    wavelengths: tuple[float, ...]

    @property
    def bound(self) -> float:
        """The error above which the surface is outside the range of scalar theory."""
        return MAX_TRUSTED_ERROR * (ESTIMATE_FACTOR if self.estimated else 1)

    @property
    def warning(self) -> str:
        """A sentence if the error exceeds the bound, otherwise ""."""
        return f"scalar theory: {self}; {self.remedy}" if self.share > self.bound else ""

    def __str__(self) -> str:
        first, last = (f"{1e3 * wavelength:.0f}" for wavelength in (self.wavelengths[0], self.wavelengths[-1]))
        light = f"{first} nm" if first == last else f"{first}–{last} nm"
        if not np.isfinite(self.share):
            return f"error unknown, the surface is deeper than two wavelengths ({light})"
        about = "about " if self.estimated else ""
        reflected, transmitted = (f"{float(f'{100 * error:.2g}'):g}%" for error in (self.share, self.transmitted))
        conditions = f"mean over {light} and 0–{max(ERROR_ANGLES):g}°, n = {INDEX:g}"
        return f"errs by {about}{reflected} of the reflected light, {transmitted} of the transmitted ({conditions})"


@dataclass(frozen=True)
class Waves:
    """The waves in the heights of a surface, from which the error of scalar theory is estimated for any light.

    Attributes:
        depth: of the sinusoid of equal roughness, µm.
        periods: µm, (n,).
        power: the fraction of the variance of each, (n,).
        width: of a profile along x, to which rigorous theory applies, µm; None of other surfaces.
        solved: the error of such a profile, solved for one light.
    """

    depth: float
    periods: tuple[float, ...]
    power: tuple[float, ...]
    width: float | None = None
    solved: ScalarError | None = None

    @classmethod
    def of(cls, height_field: HeightField, extent: str) -> Waves:
        """Determine the waves of a surface; a "sample" is levelled first."""
        frequencies, power, rms_height = height_spectrum(height_field, extent)
        kept = power > _MIN_POWER * power.sum()
        steps = np.rint(_WAVES_PER_OCTAVE * np.log2(1 / np.maximum(frequencies[kept], 1e-12)))
        found, where = np.unique(steps, return_inverse=True)
        sums = np.bincount(where, power[kept]) / max(power.sum(), 1e-300)
        periods = 2 ** (found / _WAVES_PER_OCTAVE)
        width = height_field.tile_size[0] if extent == "tile" and is_profile(height_field) else None
        return cls(float(equivalent_depth(rms_height)), tuple(periods.tolist()), tuple(sums.tolist()), width)

    def error(self, light: tuple[float, float] = VISIBLE, index: float = 1.0) -> ScalarError:
        """Return the error in light of (shortest, longest) wavelengths, nm, in a medium of an index above the surface.

        The map is averaged over the waves, each weighted by its fraction of the variance, at the depth of the sinusoid
        of equal roughness. Periods outside the map take the value at its boundary.
        """
        wavelengths = error_wavelengths(light)
        if self.solved is not None and self.solved.wavelengths == wavelengths and index == 1:
            return self.solved
        inside = [wavelength / index for wavelength in wavelengths]
        share, transmitted = (self._estimated(name, inside) for name in ("dielectric", "transmitted"))
        return ScalarError(share, transmitted, True, self._remedy(light[0] * 1e-3 / index), wavelengths)

    def _estimated(self, material: str, wavelengths: Sequence[float]) -> float:
        """Return the mean error over wavelengths in µm; infinite for too large a depth."""
        if self.depth == 0:
            return 0.0
        nodes, total = error_map()[0], 0.0
        for wavelength in wavelengths:
            depth = self.depth / wavelength
            errors = [expected_error(node, depth, 1.0, material=material, mean=True) for node in nodes]
            if not np.isfinite(errors).all():
                return float("inf")
            of_waves = np.interp(np.log(np.divide(self.periods, wavelength)), np.log(nodes), np.log(errors))
            total += float(np.exp(of_waves) @ self.power)
        return total / len(wavelengths)

    def _remedy(self, shortest: float) -> str:
        max_period = MAX_PERIOD_IN_WAVELENGTHS * shortest
        if self.width is None:
            return "no rigorous theory is offered for a surface that varies along y"
        if self.width > max_period:
            return f"rigorous theory is offered for tiles of up to {max_period:.2g} µm along x"
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
    waves, wavelengths = Waves.of(height_field, extent), error_wavelengths(light)
    if waves.width is None or waves.width > MAX_PERIOD_IN_WAVELENGTHS * light[0] * 1e-3:
        return waves
    # Deeper profiles take long to solve, and are far outside the range.
    if waves.depth > wavelengths[0]:
        return waves
    solved = _solved_error(height_field, wavelengths) if waves.depth > 0 else (0.0, 0.0)
    if not np.isfinite(solved[0]):
        return waves
    return replace(waves, solved=ScalarError(*solved, False, waves.error(light).remedy, wavelengths))


def scalar_error(height_field: HeightField, extent: str = "tile", light: tuple[float, float] = VISIBLE) -> ScalarError:
    """Determine the error of scalar theory for a surface; a "sample" is levelled first.

    Periodic profiles to which rigorous theory applies are solved. For any other surface it is estimated (`Waves`).

    Args:
        height_field: the surface.
        extent: "tile" or "sample".
        light: (shortest, longest) wavelengths, nm.
    """
    return scalar_waves(height_field, extent, light).error(light)


def _solved_error(profile: HeightField, wavelengths: Sequence[float]) -> tuple[float, float]:
    """Compute the mean error of reflected and of transmitted light; NaN if the solver does not converge."""
    period = profile.tile_size[0]
    row = HeightField(profile.heights[:1], profile.pixel_size)
    powers, curve = profile_powers(row), curve_of(row)
    errors = []
    for wavelength in wavelengths:
        for angle in ERROR_ANGLES:
            omega_i = np.array([-np.sin(np.deg2rad(angle)), 0.0, np.cos(np.deg2rad(angle))])
            exact = converge(curve, omega_i, period / wavelength, INDEX, _MAX_SOLVER_ERROR)
            if not exact.error <= _MAX_SOLVER_ERROR:
                return float("nan"), float("nan")
            scalar = scalar_orders(powers, period, wavelength, angle, INDEX)
            scalar_transmitted = transmitted_orders(powers, period, wavelength, angle, INDEX)
            wanted = (exact.orders, exact.unpolarised), (exact.transmitted_orders, exact.transmitted_unpolarised)
            # Only one of the theories may include an order exactly at the horizon, which has no power.
            errors.append(
                [
                    efficiency_difference(found.unpolarised[np.isin(found.m, m)], eta[np.isin(m, found.m)])
                    for found, (m, eta) in zip((scalar, scalar_transmitted), wanted, strict=True)
                ]
            )
    reflected, transmitted_ = np.mean(errors, axis=0)
    return float(reflected), float(transmitted_)
