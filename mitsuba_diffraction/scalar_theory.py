"""The range of scalar theory: its efficiencies in closed form, and their deviation from rigorous ones.

Scalar theory treats each facet of the surface as a plane mirror (tangent-plane approximation), which holds if the
surface varies slowly on the scale of a wavelength. A stored map quantifies its error over period/λ and depth/λ, by the
solver of `rigorous` (`precompute/scalar_theory_map.py`).
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.special import jv

from .errors import RequestError
from .geometry import k_g, transmitted
from .reference import amplitudes
from .rigorous.coordinate_transformation import curve_of, is_profile
from .rigorous.efficiencies import converge
from .rigorous.spectrum import MAX_PERIOD_IN_WAVELENGTHS
from .settings import VISIBLE
from .spectrum.grids import OrderGrid
from .surface.heightfield import HeightField
from .surface.periods import height_spectrum

Array = NDArray[np.float64]
OrderPowers = Callable[[NDArray[np.int64], Array], Array]
"""(m, κ), broadcast against each other → η_m(κ)."""

MAP = Path(__file__).parent / "data" / "scalar_error.json"

# For which the error of a surface is reported; the map is the same for ±20°.
INDEX = 1.5
ANGLES = (0.0, 20.0, -20.0)  # of incidence, degrees
WAVELENGTHS = (0.45, 0.55, 0.65)  # µm
RANGE = "mean over 450–650 nm and 0–20°, n = 1.5"

TRUSTED = 0.1  # error above which a surface is considered outside the range of scalar theory
# R.m.s. factor between the error estimated from the map and that of 48 solved profiles; docs/validation.md.
ESTIMATE_FACTOR = 1.4
_CONVERGED = 1e-2


def fresnel(cosine: ArrayLike, index: complex) -> tuple[Array, Array]:
    """Return the power reflectances (R_s, R_p) of a plane of index n + ik in air, from the cosine of incidence."""
    cosine = np.asarray(cosine, np.float64)
    root = np.sqrt(complex(index) ** 2 - (1 - cosine**2))
    s = (cosine - root) / (cosine + root)
    p = (index**2 * cosine - root) / (index**2 * cosine + root)
    return np.abs(s) ** 2, np.abs(p) ** 2


def equivalent_depth(rms_height: float) -> float:
    """Return the peak-to-valley depth of the sinusoid of equal roughness: 2√2 times the r.m.s. height (any unit)."""
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

    F_m(κ) is interpolated by Chebyshev polynomials in κ, exactly in float64: e^{iκh} varies no faster than e^{iκH}, and
    the coefficients beyond the order κH/2 fall faster than exponentially.
    """
    max_kappa = 4 * np.pi / shortest
    degree = int(np.ceil(max_kappa * height_field.half_range / 2)) + 25
    grid = OrderGrid.reachable(height_field.tile_size, height_field.shape[::-1], 2 / shortest)
    m_x, m_y = (axis.ravel() for axis in np.meshgrid(*grid.axes()))
    coefficients = chebyshev.chebinterpolate(
        lambda x: [amplitudes(height_field, kappa)[m_y, m_x] for kappa in max_kappa / 2 * (x + 1)], degree
    )

    def powers(m: NDArray[np.int64], kappa: Array) -> Array:
        inside = (np.abs(m) <= grid.max_order).all(axis=-1)
        columns, rows = np.moveaxis(np.where(inside[..., None], m + grid.max_order, 0), -1, 0)
        waves = chebyshev.chebvander(2 * kappa / max_kappa - 1, degree)
        amplitude = (waves * np.moveaxis(coefficients[:, rows * grid.shape[1] + columns], 0, -1)).sum(axis=-1)
        # Those of the Nyquist frequency have no sign.
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
    turn: float = 0.0,
) -> Orders:
    """Compute R K G E η_m(κ_m), the efficiencies of the BSDF in float64 in the limit of narrow lobes.

    Integrating the BRDF R K G S(q; κ)/λ² E (`bsdf/`) times cos θ_o over the lobe of an order, with du dv = λ² dq, gives
    these factors at the direction of the order.

    Args:
        powers: of the profile or tile.
        period: µm, of a profile; of a tile along x and y.
        wavelength: µm.
        angle: of incidence, degrees; the light comes from −x.
        index: n + ik of the material; ∞ of a perfect mirror.
        turn: of the plane of incidence, degrees; 0: it is perpendicular to the grooves, 90: parallel (conical).
    """
    pitch = wavelength / np.atleast_1d(period)
    turn, angle = np.deg2rad((turn, angle))
    light = -np.sin(angle) * np.array([np.cos(turn), np.sin(turn)])
    m, leaving, factor, cos_half = _mirror_orders(powers, pitch, wavelength, light)
    albedo = [_mirror_orders(powers, pitch, wavelength, one)[2].sum() for one in leaving]
    reflected = factor / np.maximum(1, np.maximum(factor.sum(), albedo))
    s, p = (1.0, 1.0) if np.isinf(index) else fresnel(cos_half, index)
    return Orders(m, s * reflected, p * reflected)


def transmitted_orders(
    powers: OrderPowers,
    period: float | tuple[float, float],
    wavelength: float,
    angle: float,
    index: float,
    turn: float = 0.0,
    from_below: bool = False,
    sheet: bool = False,
) -> Orders:
    """Compute K_t G_t (1 − F) η_m(κ_m), the transmitted orders of the BSDF in the limit of narrow lobes.

    Arguments are those of `scalar_orders`, of a dielectric. The angle is that in air: of incidence or, if the light
    comes from inside, of light that a plane would refract to it. The efficiencies are at most one together. Of a sheet,
    of light from above, they are those outside, times 1 − F of the flat face.
    """
    n_i, n_o, side = (index, 1.0, -1) if from_below else (1.0, index, 1)
    turn, angle = np.deg2rad((turn, angle))
    light = -np.sin(angle) * np.array([np.cos(turn), np.sin(turn)])
    m, steps = _lattice(wavelength / np.atleast_1d(period), n_i + n_o)
    square = n_o**2 - ((light + steps) ** 2).sum(axis=-1)
    m, tangent, z_o = m[square > 0], (steps[square > 0] ** 2).sum(axis=-1), np.sqrt(square[square > 0])
    z_i = np.sqrt(n_i**2 - light @ light)
    # κ and q change their signs together.
    kappa, sign = 2 * np.pi * np.abs(z_i - z_o) / wavelength, np.where(side * (z_i - z_o) < 0, -1, 1)
    cosines, relative = (z_i / n_i, z_o / n_o), n_o / n_i
    sent = transmitted(*cosines, tangent / n_i**2, relative) * powers((m.T * sign).T, kappa)
    sent = sent / max(1.0, sent.sum())
    if sheet:
        cos_out = np.sqrt(np.maximum(1 - n_o**2 + z_o**2, 0))
        sent = sent * (1 - np.mean(fresnel(cos_out, index), axis=0))
    # |ω_i·h|
    half = tangent / n_i**2 + (cosines[0] - relative * cosines[1]) ** 2
    half = np.minimum(np.abs(half + 1 - relative**2) / (2 * np.sqrt(np.maximum(half, 1e-18))), 1)
    s, p = (1 - reflected for reflected in fresnel(half, relative))
    mean = np.maximum((s + p) / 2, 1e-12)
    kept = cos_out > 0 if sheet else slice(None)
    return Orders(m[kept], (sent * s / mean)[kept], (sent * p / mean)[kept])


def _lattice(pitch: Array, reach: float) -> tuple[NDArray[np.int64], Array]:
    """Return m up to |m| λ/T = `reach`, (n,) of a profile or (n, 2), and m λ/T along x and y, (n, 2)."""
    m = np.stack(np.meshgrid(*(np.arange(-int(reach / p) - 1, int(reach / p) + 2) for p in pitch), indexing="ij"), -1)
    m = m.reshape(-1, len(pitch))
    steps = np.zeros((len(m), 2))
    steps[:, : len(pitch)] = m * pitch
    return m if len(pitch) == 2 else m[:, 0], steps


def _mirror_orders(
    powers: OrderPowers, pitch: Array, wavelength: float, light: Array
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Return the orders that R = 1 reflects, for the tangential part of ω_i, (2,).

    Args:
        pitch: λ/T, (1,) of a profile, (2,) of a tile.

    Returns:
        Of those that propagate: m, (n,) or (n, 2), the tangential part of ω_o, (n, 2), K G η_m and ω_i·h, (n,).
    """
    m, steps = _lattice(pitch, 2.0)
    leaving = -steps - light
    square_o = (leaving**2).sum(axis=-1)
    m, steps, leaving, square_o = (values[square_o < 1] for values in (m, steps, leaving, square_o))
    cos_i, cos_o = np.sqrt(1 - (light**2).sum()), np.sqrt(1 - square_o)
    w = cos_i + cos_o
    square = (steps**2).sum(axis=-1)
    half = np.sqrt(square + w**2) / 2
    return m, leaving, k_g(cos_i, cos_o, square) * powers(m, 2 * np.pi * w / wavelength), half


def difference(scalar: ArrayLike, rigorous: ArrayLike) -> float:
    """Return the L1 difference of efficiencies relative to the rigorously reflected power: Σ|Δη_m| / Σ η_m."""
    scalar, rigorous = np.asarray(scalar), np.asarray(rigorous)
    return float(np.abs(scalar - rigorous).sum() / rigorous.sum())


@functools.cache
def error_map(material: str = "dielectric") -> tuple[Array, Array, Array, Array]:
    """Return the error of scalar theory for sinusoids in unpolarised light (`precompute/scalar_theory_map.py`).

    Args:
        material: "dielectric", n = 1.5, or "Al", aluminium at 550 nm; "transmitted" and "transmitted from below", the
            light that passes the dielectric, directions being those in air.

    Returns:
        period/λ (n,), depth/λ (k,), directions (a, 2) in degrees, of incidence and of the plane of incidence from that
        perpendicular to the grooves, and the error, (n, k, a).
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
    those = errors[..., directions[:, 0] <= largest_angle]
    error = those.mean(axis=2) if mean else those.max(axis=2)
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

    The largest of the stored errors at 0°, 20°, 40° and 60° up to `largest_angle`, at 40° and 60° conical incidence
    among them, interpolated linearly in the logarithms. They are for sinusoids. Other surfaces are represented by their
    main period and their `equivalent_depth`; edges increase the error.

    Args:
        period: µm.
        depth: peak to valley, µm.
        wavelength: µm.
        material: as of `error_map`.
        largest_angle: degrees.
        mean: of these errors instead of the largest.

    Returns:
        Σ|Δη_m| relative to the reflected, or transmitted, power. Above the largest stored period (20 λ) and below the
        smallest depth (λ/20), the value at the boundary, an upper bound. NaN for periods below λ or depths above 2 λ,
        which are not stored and beyond scalar theory.

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
    place = np.minimum(period / wavelength, periods[-1]), np.maximum(depth / wavelength, depths[0])
    return float(np.exp(_interpolated(material, float(largest_angle), mean)(np.log(place))).item())


@dataclass(frozen=True)
class ScalarError:
    """The error of scalar theory for one surface: the mean over `ANGLES` and `WAVELENGTHS`, for n = 1.5.

    Attributes:
        share: Σ|Δη_m| relative to the reflected power; infinite beyond the rigorous results (depths above 2 λ).
        transmitted: the same of the transmitted light.
        estimated: from the stored map, good to a factor of `ESTIMATE_FACTOR`; otherwise solved for the surface itself.
        remedy: the alternative to scalar theory for this surface.
    """

    share: float
    transmitted: float
    estimated: bool
    remedy: str

    @property
    def bound(self) -> float:
        """The share above which the surface is outside the range of scalar theory."""
        return TRUSTED * (ESTIMATE_FACTOR if self.estimated else 1)

    @property
    def warning(self) -> str:
        """A sentence if the share is above the bound, else ""."""
        return f"scalar theory: {self}; {self.remedy}" if self.share > self.bound else ""

    def __str__(self) -> str:
        if not np.isfinite(self.share):
            return "error unknown, the surface is deeper than two wavelengths"
        about = "about " if self.estimated else ""
        reflected, passed = (f"{float(f'{100 * share:.2g}'):g}%" for share in (self.share, self.transmitted))
        return f"errs by {about}{reflected} of the reflected light, {passed} of the transmitted ({RANGE})"


def scalar_error(height_field: HeightField, extent: str = "tile") -> ScalarError:
    """Determine the error of scalar theory for a surface; a "sample" is levelled first.

    A profile that repeats and for which rigorous theory is offered is solved. For any other surface, the map is
    averaged over the waves in the spectrum of its heights, each weighted by its share of the variance, at the depth of
    the sinusoid of equal roughness. Periods outside the map take the value at its boundary.
    """
    lengths, power, rms_height = height_spectrum(height_field, extent)
    depth = equivalent_depth(rms_height)
    longest = MAX_PERIOD_IN_WAVELENGTHS * VISIBLE[0] * 1e-3
    solved = float("nan"), float("nan")
    if not (extent == "tile" and is_profile(height_field)):
        remedy = "no rigorous theory is offered for a surface that varies along y"
    elif height_field.tile_size[0] > longest:
        remedy = f"rigorous theory is offered for tiles of up to {longest:.2g} µm along x"
    else:
        remedy = "theory=rigorous has it right"
        # Deeper profiles take long to solve, and are far outside of the range.
        if depth <= WAVELENGTHS[0]:
            solved = _solved_error(height_field) if depth > 0 else (0.0, 0.0)
    if np.isfinite(solved[0]):
        return ScalarError(*solved, False, remedy)
    estimated = (_estimated_error(lengths, power, depth, name) for name in ("dielectric", "transmitted"))
    return ScalarError(*estimated, True, remedy)


def _solved_error(profile: HeightField) -> tuple[float, float]:
    """Compute the mean error of reflected and of transmitted light; NaN if the solver does not converge."""
    period = profile.tile_size[0]
    row = HeightField(profile.heights[:1], profile.pixel_size)
    powers, curve = profile_powers(row), curve_of(row)
    errors = []
    for wavelength in WAVELENGTHS:
        for angle in ANGLES:
            light = np.array([-np.sin(np.deg2rad(angle)), 0.0, np.cos(np.deg2rad(angle))])
            exact = converge(curve, light, period / wavelength, INDEX, _CONVERGED)
            if not exact.error <= _CONVERGED:
                return float("nan"), float("nan")
            scalar = scalar_orders(powers, period, wavelength, angle, INDEX)
            passed = transmitted_orders(powers, period, wavelength, angle, INDEX)
            of_exact = (exact.orders, exact.unpolarised), (exact.transmitted_orders, exact.transmitted_unpolarised)
            # An order exactly along the horizon, which has no light, may be among those of one theory only.
            errors.append(
                [
                    difference(found.unpolarised[np.isin(found.m, m)], wanted[np.isin(m, found.m)])
                    for found, (m, wanted) in zip((scalar, passed), of_exact, strict=True)
                ]
            )
    of_reflected, of_transmitted = np.mean(errors, axis=0)
    return float(of_reflected), float(of_transmitted)


def _estimated_error(lengths: Array, power: Array, depth: float, material: str) -> float:
    """Return the mean of the map over waves of these |q|, cycles/µm, and powers; infinite for too large a depth."""
    if depth == 0:
        return 0.0
    nodes = error_map()[0]
    mean = np.zeros_like(power)
    for wavelength in WAVELENGTHS:
        errors = [expected_error(node, depth / wavelength, 1.0, material=material, mean=True) for node in nodes]
        if not np.isfinite(errors).all():
            return float("inf")
        waves = -np.log(np.maximum(lengths, 1e-12) * wavelength)
        mean += np.exp(np.interp(waves, np.log(nodes), np.log(errors))) / len(WAVELENGTHS)
    return float((power * mean).sum() / power.sum())
