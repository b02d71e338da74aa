"""Comparison of the BSDF with the stored results of coupled-wave analysis, order by order.

A difference is Σ_m |Δη_m| / Σ_m η_m, a fraction of the rigorously reflected power. The claimed bounds:

- sinusoids of period ≥ 5 λ and depth ≤ λ/2, light at up to 20°: 2 %;
- blazes and triangles, which have edges, of depth ≤ λ/2, up to 20°: 10 %.

All other cases are outside the range of scalar theory and reported without a bound.
"""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...array_types import Real
from ...bsdf.testing import direction
from ...optics.geometry import Orders
from ...scalar_theory.closed_form import efficiency_difference, profile_powers, scalar_orders, sinusoid_powers
from ...scalar_theory.validity import error_map, expected_error
from ...surface import gratings
from ...surface.heightfield import HeightField
from ..record import Check, Record
from .lobes import grating, lobe_powers, spectrum_of

STORED = Path(__file__).parents[2] / "data" / "rigorous.json"
BOUNDS = {"sinusoidal": 0.02, "blazed": 0.1, "triangular": 0.1}
MIN_PERIOD, MAX_DEPTH, MAX_ANGLE = 5.0, 0.5, 20.0  # in wavelengths, degrees


def triangular(period: float, depth: float, *, samples: int = 512) -> HeightField:
    """Return h = depth (1 − |2x/period − 1|) over one period, (1, samples); lengths in µm."""
    x = (np.arange(samples) + 0.5) / samples
    return HeightField(depth * (1 - np.abs(2 * x - 1))[None, :], (period / samples, period), "triangular grating")


SOLVED_PROFILES: dict[str, Callable[..., HeightField]] = {
    "sinusoidal": gratings.sinusoidal,
    "blazed": gratings.blazed,
    "triangular": triangular,
}


@dataclass(frozen=True)
class RigorousResult:
    """One stored result.

    Attributes:
        profile: a name of `SOLVED_PROFILES`.
        period, depth, wavelength: µm.
        angle: of incidence, degrees; the light is incident from −x.
        material: "dielectric" (n = 1.5) or a metal by Mitsuba's name.
        index: n + ik.
        orders: the orders that propagate, (n,).
        te, tm: rigorous efficiencies, (n,).
        change: of the efficiencies at the last refinement, as a fraction of the reflected power.
    """

    profile: str
    period: float
    depth: float
    wavelength: float
    angle: float
    material: str
    index: complex
    orders: NDArray[np.int64]
    te: Real
    tm: Real
    change: float

    @property
    def unpolarised(self) -> Real:
        """Mean of `te` and `tm`, (n,)."""
        return (self.te + self.tm) / 2

    @property
    def in_range(self) -> bool:
        """Whether a bound is claimed."""
        fine = self.period >= MIN_PERIOD * self.wavelength or self.profile != "sinusoidal"
        return fine and self.depth <= MAX_DEPTH * self.wavelength and self.angle <= MAX_ANGLE

    def __str__(self) -> str:
        return (
            f"{self.period:g} × {self.depth:g} µm ({self.period / self.wavelength:.1f} × "
            f"{self.depth / self.wavelength:.2f} λ), {self.angle:g}°"
        )

    def scalar(self) -> Orders:
        """Compute R K G E η_m of this case, in float64."""
        powers = profile_powers(SOLVED_PROFILES[self.profile](self.period, self.depth))
        return scalar_orders(powers, self.period, self.wavelength, self.angle, self.index)

    def found(self) -> Real:
        """Return the efficiencies of the BSDF, (n,)."""
        spectrum, bsdf = _plugin(self.profile, self.period, self.depth, self.material)
        q = np.stack([self.orders / self.period, np.zeros(len(self.orders))], axis=-1)
        return lobe_powers(bsdf, spectrum, direction(self.angle, 180.0), q, self.wavelength)


def _plugin(profile: str, period: float, depth: float, material: str) -> tuple[Any, Any]:
    spectrum = spectrum_of(SOLVED_PROFILES[profile](period, depth), coherence_length=200.0, tolerance=1e-4)
    parameters = {"int_ior": 1.5, "ext_ior": 1.0} if material == "dielectric" else {"material": material}
    return spectrum, grating(spectrum, **parameters)


@functools.cache
def stored() -> dict[str, Any]:
    """Return the stored rigorous results, as `tools/data/rigorous_reference.py` wrote them."""
    return json.loads(STORED.read_text(encoding="utf-8"))


@functools.cache
def cases() -> tuple[RigorousResult, ...]:
    """Return all stored results."""
    names = ("profile", "period", "depth", "wavelength", "angle", "material", "change")
    return tuple(
        RigorousResult(
            **{name: case[name] for name in names},
            index=complex(*case["index"]),
            orders=np.arange(case["orders"][0], case["orders"][1] + 1),
            te=np.array(case["te"]),
            tm=np.array(case["tm"]),
        )
        for case in stored()["cases"]
    )


def _compare(profile: str, choose: Callable[[RigorousResult], bool], metal: bool = False, te: bool = False) -> Record:
    """Return the record of the chosen case with the maximum difference; its note quotes the strongest order.

    Compares the BSDF for unpolarised light, or scalar theory for `te`. For metals no bound is claimed: see
    docs/validation.md.
    """
    those = [c for c in cases() if c.profile == profile and (c.material != "dielectric") == metal and choose(c)]
    pairs = [(case.scalar().s, case.te) if te else (case.found(), case.unpolarised) for case in those]
    differences = [efficiency_difference(*pair) for pair in pairs]
    index = int(np.argmax(differences))
    found, rigorous = pairs[index]
    strongest = int(np.argmax(rigorous))
    note = (
        f"Σ|Δη|/Σ η, maximum of {len(those)}: {those[index]}; order {those[index].orders[strongest]} has "
        f"{found[strongest]:.4g}, rigorous {rigorous[strongest]:.4g}; "
        f"converged to {max(case.change for case in those):.1e}"
    )
    bound = BOUNDS[profile] if not metal and all(case.in_range for case in those) else None
    return Record(differences[index], 0.0, bound, note=note)


def formula(those: Iterable[RigorousResult]) -> Record:
    """Compare R K G E η_m in float64, on which the map is based, with the BSDF integrated lobe by lobe."""
    differences = [efficiency_difference(case.scalar().unpolarised, case.found()) for case in those]
    # E is read from a table of lower bounds.
    note = f"Σ|Δη|/Σ η, maximum of {len(differences)}; mean {np.mean(differences):.1e}"
    return Record(np.max(differences), 0.0, 2e-2, note=note)


def polarised_fractions(case: RigorousResult) -> tuple[Real, Real, Real]:
    """Return η_te/(η_te + η_tm), rigorous and by R_s and R_p at the half vector, and the fraction of power in each."""
    orders = case.scalar()
    total = case.te + case.tm
    with np.errstate(invalid="ignore", divide="ignore"):
        rigorous, scalar = case.te / total, orders.s / (orders.s + orders.p)
    return np.nan_to_num(rigorous, nan=0.5), np.nan_to_num(scalar, nan=0.5), total / total.sum()


def _polarisation(split: bool) -> Record:
    """Compare the power-weighted mean fraction of s-polarised light in the orders, for unpolarised light below 40°."""
    rows = []
    for case in cases():
        if case.material == "dielectric" and case.angle < 40:
            rigorous, scalar, weight = polarised_fractions(case)
            rows.append((float(weight @ np.abs((scalar if split else 0.5) - rigorous)), str(case)))
    max_difference, worst = max(rows)
    note = f"mean |Δ| over orders, maximum of {len(rows)}: {worst}; mean {np.mean([row[0] for row in rows]):.3f}"
    return Record(max_difference, 0.0, 0.1 if split else None, note=note)


def _map(min_period: float, max_depth: float, bound: float | None) -> Record:
    """Return the maximum error of the map, at its nodes and, between them, at the minimum period and maximum depth."""
    periods, depths, _, _ = error_map()
    points = itertools.product([min_period, *periods[periods > min_period]], [*depths[depths < max_depth], max_depth])
    max_error, period, depth = max((expected_error(period, depth, 1.0), period, depth) for period, depth in points)
    return Record(max_error, 0.0, bound, note=f"Σ|Δη|/Σ η, maximum at {period:g} × {depth:g} λ")


def _map_against_coupled_waves() -> Record:
    """Compare the map, of this package's rigorous efficiencies, with coupled waves at the same periods and depths."""
    periods, depths, directions, errors = error_map()
    found, expected = [], []
    for point in stored()["map"]:
        arguments = point["period"], 1.0, point["angle"]
        scalar = scalar_orders(sinusoid_powers(point["depth"]), *arguments, complex(stored()["map index"]))
        expected.append(efficiency_difference(scalar.unpolarised, point["unpolarised"]))
        angle = np.flatnonzero((directions == [point["angle"], 0]).all(axis=1))[0]
        found.append(errors[np.searchsorted(periods, point["period"]), np.searchsorted(depths, point["depth"]), angle])
    return Record.at_max_error(np.array(expected), np.array(found), 0.01, f"{len(found)} sinusoids, 0° and 20°")


def _check(name: str, measure: Callable[[], Record], slow: bool = False) -> Check:
    return Check("rigorous", name, measure, "coupled waves (meent), stored", slow)


def _of_profile(profile: str) -> tuple[Check, ...]:
    angle_range = f"≤ {MAX_ANGLE:g}°"
    period_range = f", period ≥ {MIN_PERIOD:g} λ" if profile == "sinusoidal" else ""

    def check(name: str, choose: Callable[[RigorousResult], bool], slow: bool = True, **of: bool) -> Check:
        return _check(f"{profile}, {name}", functools.partial(_compare, profile, choose, **of), slow)

    def near_normal(case: RigorousResult) -> bool:
        return case.angle <= MAX_ANGLE

    return (
        check(f"n = 1.5, depth ≤ λ/2{period_range}, {angle_range}", lambda case: case.in_range),
        check(f"n = 1.5, {angle_range}, outside that range", lambda case: not case.in_range and near_normal(case)),
        check("n = 1.5, 40°", lambda case: case.angle == 40),
        check("n = 1.5, 60°", lambda case: case.angle == 60),
        check(f"Al, {angle_range}, s", near_normal, slow=False, metal=True, te=True),
        check(f"Al, {angle_range}, unpolarised", near_normal, metal=True),
    )


CHECKS = (
    Check(
        "rigorous",
        "BSDF's lobes against R K G E η_m",
        lambda: formula(case for case in cases() if case.angle <= 40),
        "closed form, float64",
        slow=True,
    ),
    *(check for profile in SOLVED_PROFILES for check in _of_profile(profile)),
    _check("map against coupled waves", _map_against_coupled_waves),
    _check("map, period ≥ 5 λ, depth ≤ λ/2", lambda: _map(5.0, 0.5, 0.02)),
    _check("map, period ≥ 3.5 λ, depth ≤ λ/5", lambda: _map(3.5, 0.2, 0.02)),
    _check("map, period ≥ 3.5 λ, depth ≤ λ/2", lambda: _map(3.5, 0.5, None)),
    _check("fraction of s-polarised light, by R_s and R_p", lambda: _polarisation(True)),
    _check("fraction of s-polarised light, assumed to be 1/2", lambda: _polarisation(False)),
)
