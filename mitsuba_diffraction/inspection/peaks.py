"""The light in the peaks of the spectrum of an irregular surface, the counterpart of the orders of a grating.

An irregular surface spreads its orders over the frequency plane. Its peaks are found in S(q; κ) + S(−q; κ) at normal
incidence, the mean over the requested wavelengths, smoothed by one lobe width σ_q against speckle. Each frequency
belongs to the maximum to which it ascends. Of two maxima, the lower one is a peak of its own if S falls between them
(at its saddle) to less than `_MAX_SADDLE` of the lower maximum. A peak extends down to its saddle, or to 1/e² of its
maximum: for a single lobe to 2√2 σ_q, which is 98 % of its power.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter

from ..array_types import Real
from ..errors import RequestError
from ..optics.geometry import fresnel
from ..optics.media import Media, MediumBelow
from ..progress import Progress, silent
from ..scalar_theory.closed_form import incident_direction, mirrored
from ..spectrum.grids import OrderGrid
from ..spectrum.power_spectrum import PowerSpectrum
from ..surface.periods import Period
from .efficiency import OrderEfficiencies, checked_numbers, description

_MAX_SADDLE = 0.5  # of the lower of two peaks
_EDGE = np.exp(-2.0)  # of its maximum, down to which a peak extends
_MIN_DENSITY = 1e-6  # of a peak, relative to the maximum
_MIN_POWER = 1e-3  # of a pair of peaks, fraction of the reflected power
_NAMES = "abc"
_MAX_SPACING = 3.0  # of orders, in σ_q, for them to overlap


@dataclass(frozen=True, eq=False)
class PeakEfficiencies(OrderEfficiencies):
    """The fraction of the incident power in each peak of the spectrum of an irregular surface.

    Attributes:
        orders: "mirror", the undiffracted light; "+a" and "-a", the peaks at q and −q, and so on; "rest", all other
            reflected light.
        peaks: "a", "b", …, of the largest powers, in this order. Uncertainties are the r.m.s. widths of the peak, the
            strength is the fraction of the power at q and −q, of R = 1.
    """

    peaks: tuple[Period, ...] = ()

    def __str__(self) -> str:
        """Return a line for each peak, and the table of `OrderEfficiencies`."""
        table = super().__str__().partition("\n")
        found = [f"peak {name}: period {peak}" for name, peak in zip(_NAMES, self.peaks, strict=False)]
        return "\n".join([table[0], *(found or ["no peak stands out beside the mirror direction"]), table[2]])


def peak_efficiencies(
    spectrum: PowerSpectrum,
    angles: ArrayLike,
    wavelengths: ArrayLike,
    *,
    material: str | None = None,
    int_ior: complex | str | None = None,
    azimuth: float = 0.0,
    progress: Progress = silent,
) -> PeakEfficiencies:
    """Compute how much light the peaks of the spectrum of an irregular surface reflect, in air.

    The BRDF R K G E S(q; κ)/λ² is integrated over each peak, with du dv = λ² dq, and with E at the centre of the peak.
    For directions see `efficiencies`.

    Args:
        spectrum: of a sample, or of a tile whose orders overlap.
        angles: of incidence, degrees, one or (a,), above −90 and below 90.
        wavelengths: nm, one or (w,), for which the spectrum was built.
        material: see `efficiencies`.
        int_ior: likewise.
        azimuth: likewise.
        progress: called with (steps done, steps in all).

    Raises:
        ValueError: if an argument is out of range, or the orders of a tile do not overlap.
    """
    return efficiencies_of_peaks(spectrum, MediumBelow.of(material, int_ior), angles, wavelengths, azimuth, progress)


def efficiencies_of_peaks(
    spectrum: PowerSpectrum,
    below: MediumBelow,
    angles: ArrayLike,
    wavelengths: ArrayLike,
    azimuth: float,
    progress: Progress,
) -> PeakEfficiencies:
    """Compute `peak_efficiencies` of a surface above a medium; the same arguments and errors."""
    angles, wavelengths = check_request(spectrum.wavelengths, angles, wavelengths, below)
    spacing = [float(q[1] - q[0]) if len(q) > 1 else np.inf for q in spectrum.grid.frequencies()]
    if isinstance(spectrum.grid, OrderGrid) and max(spacing) > _MAX_SPACING * spectrum.lobe_width:
        raise RequestError(
            f"spectrum: got orders of a tile that do not overlap ({spectrum.source}), wanted the spectrum of an "
            "irregular surface; of a grating, give the recipe or the profile"
        )
    mean = np.mean([_reflected(spectrum, np.zeros(2), w * 1e-3)[0] for w in wavelengths], axis=0)
    peaks, regions = _peaks(spectrum, mean, spacing)
    centres = [np.zeros(2), *(sign * peak.q for peak in peaks for sign in (1, -1))]
    values = np.zeros((len(regions) + 1, len(angles), len(wavelengths), 2))
    for step, (a, w) in enumerate(np.ndindex(values.shape[1:3]), 1):
        wavelength, direction = float(wavelengths[w]) * 1e-3, incident_direction(float(angles[a]), azimuth)[:2]
        power, cos_half = _reflected(spectrum, direction, wavelength)
        index, albedo = below.index_at(wavelength), max(1.0, power.sum())
        polarised = np.stack(fresnel(cos_half, index)) * power
        for k, (region, centre) in enumerate(zip(regions, centres, strict=True)):
            other = _reflected(spectrum, -direction - wavelength * centre, wavelength)[0].sum()
            values[k, a, w] = polarised[:, region].sum(axis=1) / max(albedo, other)
        values[-1, a, w] = polarised[:, ~np.any(regions, axis=0)].sum(axis=1) / albedo
        progress(step, len(angles) * len(wavelengths))
    names = ["mirror", *(f"{sign}{name}" for name in _NAMES[: len(peaks)] for sign in "+-"), "rest"]
    source = description(spectrum.source, Media(below), azimuth)
    return PeakEfficiencies(values, np.array(names), angles, wavelengths, source, peaks)


def check_request(
    valid: tuple[float, float], angles: ArrayLike, wavelengths: ArrayLike, below: MediumBelow
) -> tuple[Real, Real]:
    """Return angles (a,) and wavelengths (w,) if the arguments of `peak_efficiencies` are right.

    Raises:
        ValueError: if one is out of range; `valid` are the wavelengths of the spectrum in nm.
    """
    low, high = valid
    wanted = f"nm from {low:g} to {high:g}, for which the spectrum is valid"
    wavelengths = checked_numbers("wavelengths", wavelengths, wanted, low - 1e-3, high + 1e-3)
    for wavelength in wavelengths:
        below.index_at(wavelength * 1e-3)
    return checked_numbers("angles", angles, "degrees above −90 and below 90", -90.0, 90.0), wavelengths


def _reflected(spectrum: PowerSpectrum, direction: Real, wavelength: float) -> tuple[Real, Real]:
    """Return K G times the power of each node of the spectrum, and ω_i·h, (N_y, N_x); 0 where ω_o is evanescent.

    Args:
        spectrum: S(q; κ).
        direction: the tangential part of ω_i, (2,); nothing is reflected if it is evanescent.
        wavelength: µm.
    """
    q = np.stack(np.meshgrid(*spectrum.grid.frequencies()), -1)
    power, cos_half = np.zeros(q.shape[:2]), np.ones(q.shape[:2])

    def of_nodes(kept: NDArray[np.bool_], kappa: Real) -> NDArray[np.floating]:
        row, column = np.nonzero(kept)
        return spectrum.table.powers_at(row, column, kappa)

    found, reflected = mirrored(of_nodes, direction, wavelength * q, wavelength)
    power[found.kept], cos_half[found.kept] = reflected, found.cos_half
    return power, cos_half


def _peaks(
    spectrum: PowerSpectrum, power: Real, spacing: list[float]
) -> tuple[tuple[Period, ...], list[NDArray[np.bool_]]]:
    """Return the strongest peaks of powers at normal incidence, and the nodes of the mirror direction and of ±q."""
    sigma = [spectrum.lobe_width / step for step in reversed(spacing)]
    even = gaussian_filter(power + power[::-1, ::-1], sigma, mode="constant")
    q = np.stack(np.meshgrid(*spectrum.grid.frequencies()), -1)
    found, mirror = [], np.zeros(power.shape, bool)
    for region in _regions(even):
        opposite = region[::-1, ::-1]
        if region[tuple(n // 2 for n in power.shape)] or (region & opposite).any():
            mirror |= region & opposite
            continue
        weight = np.maximum(power + power[::-1, ::-1], 0)[region]
        strength = float(power[region | opposite].sum() / power.sum())
        if weight.sum() > 0 and strength > _MIN_POWER:
            peak = _period(q[region], weight / weight.sum(), strength)
            if weight @ q[region] @ peak.q > 0:  # one of q and −q
                found.append((peak, region, opposite))
    found = sorted(found, key=lambda one: -one[0].strength)[: len(_NAMES)]
    return tuple(peak for peak, *_ in found), [mirror, *(region for _, *pair in found for region in pair)]


def _period(q: Real, weight: Real, strength: float) -> Period:
    """Return the period of a peak from its frequencies, (n, 2), and weights of sum one; with its r.m.s. widths."""
    length = np.hypot(*q.T)
    mean = weight @ length
    centre = Period.of(weight @ q, np.zeros((2, 2)), strength)
    along = np.deg2rad(centre.direction)
    off = np.degrees(np.arctan(np.tan(np.arctan2(q[:, 1], q[:, 0]) - along)))  # within ±90°
    width = np.sqrt(weight @ (length - mean) ** 2) / mean**2
    return Period(1 / mean, centre.direction, float(width), float(np.sqrt(weight @ off**2)), strength)


def _regions(power: Real) -> Iterator[NDArray[np.bool_]]:
    """Yield the peaks of powers, (N_y, N_x), as masks."""
    width = power.shape[1] + 2  # of the array with a margin
    owner = [-1] * (width * (power.shape[0] + 2))
    parent: dict[int, int] = {}
    top: dict[int, float] = {}
    saddle: dict[int, float] = {}

    def peak_of(node: int) -> int:
        while (above := parent[node]) != node:
            node = above
        return node

    row, column = np.nonzero(power > _MIN_DENSITY * power.max())
    order = np.argsort(-power[row, column], kind="stable")
    nodes = (row + 1) * width + column + 1
    around = (-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1)
    for node, value in zip(nodes[order].tolist(), power[row, column][order].tolist(), strict=True):
        near = {peak_of(other) for step in around if (other := owner[node + step]) >= 0}
        highest = max(near, key=top.__getitem__, default=node)
        owner[node] = highest
        if not near:
            parent[node], top[node] = node, value
        for lower in near - {highest}:
            if value > _MAX_SADDLE * top[lower]:
                parent[lower] = highest
            else:
                saddle.setdefault(lower, value)
    labels = np.full(power.shape, -1)
    labels[row, column] = [peak_of(owner[node]) for node in nodes.tolist()]
    for peak in set(map(peak_of, parent)):
        yield (labels == peak) & (power >= max(_EDGE * top[peak], saddle.get(peak, 0.0)))
