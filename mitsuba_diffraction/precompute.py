"""From a height field to its spectrum, to a tolerance."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np

from .coherence import SUN_COHERENCE_LENGTH, lobe_width
from .expansions.taylor import TaylorSeries
from .heightfield import HeightField
from .reference import check_extent, order_powers
from .spectrum import GratingSpectrum
from .spectrum.grating_spectrum import TAIL_SHARE, check_wavelengths
from .spectrum.orders import OrderGrid
from .spectrum.series_table import SeriesTable
from .spectrum.slice_table import SliceTable

VISIBLE = (360.0, 830.0)  # nm, the range that Mitsuba samples
REPRESENTATIONS = ("auto", TaylorSeries.NAME, SliceTable.representation)

Progress = Callable[[int, int], None]


def precompute(
    height_field: HeightField,
    *,
    extent: str = "tile",
    coherence_length: float = SUN_COHERENCE_LENGTH,
    wavelengths: tuple[float, float] = VISIBLE,
    representation: str = "auto",
    tolerance: float = 1e-3,
    progress: Progress | None = None,
) -> GratingSpectrum:
    """The spectrum of the phase e^{iκh}, its error at most `tolerance`.

    Args:
        height_field: the surface.
        extent: "tile": the patch repeats for ever.
        coherence_length: L_c in µm.
        wavelengths: (shortest, longest) in nm.
        representation: "taylor" or "slices"; "auto" takes the one that reads the fewest numbers: slices.
        tolerance: bound of max over κ of ∫|S_approx(q; κ) − S_exact(q; κ)| dq, a share of the reflected power.
        progress: called with (steps done, steps in all).

    Returns:
        The spectrum; its `error` is what was measured, at values of κ that were not used to build it.

    Raises:
        ValueError: if an argument is out of range, or the tolerance cannot be kept in float32 for so deep a surface.

    Warns:
        UserWarning: if the pixels are too coarse to hold all the frequencies that the shortest wavelength can reach.
    """
    check_extent(extent)
    check_wavelengths(wavelengths)
    lobe_width(coherence_length)
    if representation not in REPRESENTATIONS:
        raise ValueError(f"representation: got {representation!r}, wanted one of {', '.join(REPRESENTATIONS)}")
    if not 1e-5 <= tolerance < 1:
        raise ValueError(f"tolerance: got {tolerance!r}, wanted a share of the reflected power from 1e-5 to 1")
    shortest = wavelengths[0] * 1e-3
    largest_kappa = 4 * np.pi / shortest
    _check_resolution(height_field, shortest)
    rows, columns = height_field.shape
    orders = OrderGrid.reachable(height_field.tile_size, (columns, rows), shortest)
    build = _taylor if representation == TaylorSeries.NAME else _slices
    table, error = build(
        height_field, orders, largest_kappa, (1 - TAIL_SHARE) * tolerance, progress or (lambda done, total: None)
    )
    return GratingSpectrum(
        table=table,
        grid=orders,
        pixel_size=height_field.pixel_size,
        height_range=height_field.height_range,
        coherence_length=float(coherence_length),
        wavelengths=(float(wavelengths[0]), float(wavelengths[1])),
        tolerance=float(tolerance),
        error=error + TAIL_SHARE * tolerance,
        source=height_field.source,
        source_digest=height_field.digest,
        extent=extent,
    )


def _taylor(
    height_field: HeightField, orders: OrderGrid, largest_kappa: float, tolerance: float, progress: Progress
) -> tuple[SeriesTable, float]:
    x = largest_kappa * height_field.half_range
    refusal = (
        f"taylor: a surface of height range {height_field.height_range:.3g} µm cannot be kept to {tolerance:.2g} "
        f"in float32 up to κ = {largest_kappa:.1f} rad/µm: the terms of the series grow to e^{x:.1f} and cancel; "
        "representation 'slices' keeps it"
    )
    # Each term is good to 2^-24 of its size, and their sizes add up to e^x; the bound is generous by 20.
    if 2.0**-24 * np.exp(min(x, 80.0)) > 20 * tolerance:
        raise ValueError(refusal)
    # The other half is left to rounding.
    series = TaylorSeries.for_tolerance(height_field.half_range, largest_kappa, 0.5 * tolerance)
    table = SeriesTable.build(series, height_field, orders, progress)
    error = _measured(table, height_field, orders, largest_kappa)
    if error > tolerance:
        raise ValueError(f"{refusal} (measured error {error:.2g})")
    return table, error


def _slices(
    height_field: HeightField, orders: OrderGrid, largest_kappa: float, tolerance: float, progress: Progress
) -> tuple[SliceTable, float]:
    # A cubic on Chebyshev points errs by (RΔκ)⁴/3072 of an oscillation of angular frequency R. Few heights are R apart,
    # so begin with a quarter of the intervals that this asks for.
    step = 4 * (3072 * tolerance) ** 0.25
    intervals = max(1, int(np.ceil(largest_kappa * height_field.height_range / step)))
    while True:
        table = SliceTable.build(intervals, largest_kappa, height_field, orders, progress)
        error = _measured(table, height_field, orders, largest_kappa)
        # What lies between the κ that were measured may be a little worse.
        if error <= 0.7 * tolerance:
            return table, error / 0.7
        intervals = max(intervals + 1, int(intervals * (error / tolerance) ** 0.25))


def _measured(
    table: SeriesTable | SliceTable, height_field: HeightField, orders: OrderGrid, largest_kappa: float
) -> float:
    """max over held-out κ of Σ_m |η_m − exact|: both ends, and others between, at least four to an oscillation."""
    count = 12 + int(np.ceil(largest_kappa * height_field.height_range))
    golden = (np.sqrt(5) - 1) / 2
    held_out = largest_kappa * np.concatenate([[0.0, 1.0], np.sqrt((np.arange(1, count) * golden) % 1)])
    return max(
        float(np.abs(table.powers(kappa) - orders.take(order_powers(height_field, kappa))).sum()) for kappa in held_out
    )


def _check_resolution(height_field: HeightField, shortest: float) -> None:
    for axis, size, count in zip("xy", height_field.pixel_size, height_field.shape[::-1], strict=True):
        if count > 1 and size > shortest / 4:
            warnings.warn(
                f"pixels of {size * 1e3:.4g} nm along {axis} hold no frequency beyond {1 / (2 * size):.3g} cycles/µm, "
                f"but light of {shortest * 1e3:.4g} nm reaches {2 / shortest:.3g}: what lies between is missing",
                stacklevel=3,
            )
