"""Error and speed of the amplitude series against their number of terms, beside slices, FFTs and the shaders."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import math
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ...precomputation.grating_spectrum import GratingSpectrum
from ...progress import Progress, cells, silent, table
from ...scalar_theory.reference import order_powers
from ...settings import ORIGINS, SERIES, VISIBLE
from ...shader_2014.flss import FLSS
from ...shader_2014.shader import TextureShader
from ...spectrum.grids import OrderGrid
from ...spectrum.tables import AmplitudeTable, SliceTable, series_function, series_weights
from ..plots import figure
from .accuracy import Exact
from .cases import Case
from .shader_speed import shader_difference, shaders_of, shading
from .speed import Rays, seconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.table import Table

PUBLISHED_TERMS = FLSS.published_terms
TERMS = tuple(range(5, 46))
SHOWN_TERMS = (20, 25, 30, 37)
"""Of tables; the published FLSS sums 37."""
MAX_KAPPA = 4 * np.pi / (VISIBLE[0] * 1e-3)
_KAPPA_FRACTIONS = (0.25, 0.5, 0.75, 1.0)  # of MAX_KAPPA, over which errors are maximal
_MIN_POWER = 1e-3  # of the strongest order, of those whose relative error counts

THESIS_PHASE, THESIS_WAVELENGTH = 1.5 * np.pi, 400.0
"""Maximum phase of the thesis' example, heights of 0.15 µm at 400 nm (eq. 3.25)."""
THESIS_BOUNDS = {20: 2.995e-4, 25: 8.815e-8, 30: 1.005e-11}
"""Exponent N of the last term → bound, as printed after eq. 3.26."""

TOLERANCE = 1e-3  # of slices
_MIN_TIMED_PIXELS = 1 << 19  # of the FFTs that are timed together
_FFT = "FFT for each κ (reference)"


@dataclass(frozen=True)
class SeriesErrors:
    """Errors of a series of a tile against its number of terms, the maximum over κ up to `MAX_KAPPA`.

    Attributes:
        surface: name of the case.
        representation: "taylor" or "chebyshev".
        heights_from: "mean" or "lowest".
        precision: "float32", as stored and summed by a renderer, or "float64".
        phase: x = κ_max max|h|, rad.
        terms: N.
        errors: ∫|ΔS| dq over the frequencies of light, a fraction of the reflected power.
        relative_errors: max |Δη_m|/η_m over orders of at least 1e-3 of the power of the strongest at the same κ.
    """

    surface: str
    representation: str
    heights_from: str
    precision: str
    phase: float
    terms: tuple[int, ...]
    errors: tuple[float, ...]
    relative_errors: tuple[float, ...]

    def needed(self, tolerance: float) -> int:
        """Return the smallest N from which on the error stays within the tolerance; without one, the largest N."""
        above = [n for n, error in zip(self.terms, self.errors, strict=True) if not error <= tolerance]
        return min(max(above, default=self.terms[0] - 1) + 1, self.terms[-1])

    def error(self, terms: int) -> float:
        """Return ∫|ΔS| dq of N terms."""
        return self.errors[self.terms.index(terms)]

    def relative_error(self, terms: int) -> float:
        """Return max |Δη_m|/η_m of N terms."""
        return self.relative_errors[self.terms.index(terms)]


def lagrange_bound(phase: float, terms: int) -> float:
    """Return x^N/N!, the bound of |e^{ix} − Σ_{n<N} (ix)ⁿ/n!|: all derivatives of e^{ix} have modulus one."""
    return math.exp(terms * math.log(phase) - math.lgamma(terms + 1))


def power_bound(amplitude_error: float) -> float:
    """Return 2ε + ε², the bound of Σ|Δη_m| if amplitudes are wrong by ε at every point of the tile."""
    return amplitude_error * (2 + amplitude_error)


def series_errors(case: Case) -> Iterator[SeriesErrors]:
    """Compute the errors of both series of a tile, from both origins and in both precisions: eight results."""
    field = case.height_field
    grid = OrderGrid.reachable(field.tile_size, field.shape[::-1], MAX_KAPPA / (2 * np.pi))
    kappas = [fraction * MAX_KAPPA for fraction in _KAPPA_FRACTIONS]
    exact = [grid.take(order_powers(field, kappa)) for kappa in kappas]
    for kind, origin in itertools.product(SERIES, ORIGINS):
        heights = field.heights - (field.heights.min() if origin == "lowest" else field.heights.mean())
        height = float(np.abs(heights).max())
        functions = (series_function(kind, n, heights / height) for n in range(TERMS[-1]))
        terms = np.stack([grid.take(scipy.fft.fft2(f, norm="forward"), 0.5**0.5) for f in functions])
        stored = AmplitudeTable(kind, MAX_KAPPA, height, terms.astype(np.complex64))
        for precision, values in (("float32", stored.terms), ("float64", terms)):
            found = np.zeros((2, len(TERMS)))
            for kappa, wanted in zip(kappas, exact, strict=True):
                weights = series_weights(kind, TERMS[-1], kappa * height).astype(values.dtype)
                found = np.maximum(found, _partial_sum_errors(weights, values, wanted))
            errors, relative = (tuple(map(float, row)) for row in found)
            yield SeriesErrors(case.name, kind, origin, precision, MAX_KAPPA * height, TERMS, errors, relative)


def _partial_sum_errors(weights: NDArray, terms: NDArray, wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the errors and the relative errors of |Σ_{n<N} c_n F_nm|², for N of `TERMS`, (2, N)."""
    strong = wanted >= _MIN_POWER * wanted.max()
    amplitude, found = np.zeros(wanted.shape, terms.dtype), []
    for n, (weight, term) in enumerate(zip(weights, terms, strict=True), 1):
        amplitude += weight * term
        if n in TERMS:
            difference = np.abs(amplitude.real**2 + amplitude.imag**2 - wanted)
            found.append((difference.sum(), (difference[strong] / wanted[strong]).max()))
    return np.transpose(found)


@dataclass(frozen=True)
class Bound:
    """Bounds of the error of Taylor terms up to the exponent N, n ≤ N, for phases up to 1.5π, and the error itself.

    Attributes:
        exponent: N.
        printed: in the thesis.
        thesis: e^x x^{N+1}/(N+1)!, its formula (eq. 3.26).
        lagrange: x^{N+1}/(N+1)!.
        found: max |e^{ix} − Σ (ix)ⁿ/n!| over 0 ≤ x ≤ 1.5π.
    """

    exponent: int
    printed: float
    thesis: float
    lagrange: float
    found: float


def bounds() -> list[Bound]:
    """Compute the bounds for the numbers of terms that the thesis gives."""
    x = np.linspace(0, THESIS_PHASE, 1000)
    result = []
    for exponent, printed in THESIS_BOUNDS.items():
        series = series_weights("taylor", exponent + 1, x).sum(axis=-1)
        lagrange = lagrange_bound(THESIS_PHASE, exponent + 1)
        found = float(np.abs(np.exp(1j * x) - series).max())
        result.append(Bound(exponent, printed, math.exp(THESIS_PHASE) * lagrange, lagrange, found))
    return result


@dataclass(frozen=True)
class Method:
    """Cost and accuracy of a way to evaluate a tile, on one core.

    Attributes:
        surface: name of the case.
        name: of the method.
        terms: N, if it sums a series.
        transforms: FFTs of the tile behind the table; None if each evaluation takes its own.
        words: of 32 bits read for one evaluation, of four wavelengths; for a shader, for one shading point.
        megabytes: of the table or the textures.
        error: ∫|ΔS| dq in float32, if S is what it computes; None for the reference.
        delta_e: (mean, maximum) CIEDE2000 of twelve patches of colour.
        time_ratio: of one evaluation, relative to slices in the same run.
    """

    surface: str
    name: str
    terms: int | None
    transforms: int | None
    words: int | None
    megabytes: float
    error: float | None
    delta_e: tuple[float, float]
    time_ratio: float

    @property
    def label(self) -> str:
        """The method with its number of terms."""
        return self.name if self.terms is None else f"{self.name}, {self.terms} terms"


def methods(
    case: Case,
    errors: Sequence[SeriesErrors],
    *,
    count: int = 1 << 17,
    shading_points: int = 1 << 11,
    repetitions: int = 5,
) -> list[Method]:
    """Measure slices, series of `SHOWN_TERMS`, an FFT for each κ and the shaders under the current variant.

    Directions ω_o are drawn by the grating itself, so that every evaluation reads an order.

    Args:
        case: the tile.
        errors: of the same case.
        count: rays at once.
        shading_points: of the shaders at once.
        repetitions: of each timing, interleaved.
    """
    series = [e for e in errors if (e.heights_from, e.precision) == ("mean", "float32")]
    exact, spectra = Exact(case, VISIBLE, kappas=0), _spectra(case, series)
    shaders = shaders_of(case)
    rays, points = Rays(count), Rays(shading_points)
    bsdfs = {
        name: mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "material": "Al"})
        for name, spectrum in spectra.items()
    }
    rays.wo = bsdfs["slices", None].sample(mi.BSDFContext(), rays.si, rays.sample1, rays.sample2)[0].wo
    dr.eval(rays.wo)
    # Several FFTs of a small tile, as one takes too little time.
    kappas = np.linspace(0.3, 1, max(1, _MIN_TIMED_PIXELS // case.height_field.heights.size)) * MAX_KAPPA
    work: dict[Hashable, Callable[[], object]] = {
        _FFT: lambda: [order_powers(case.height_field, kappa) for kappa in kappas]
    }
    work |= {name: functools.partial(rays.evaluate, bsdf) for name, bsdf in bsdfs.items()}
    work |= {name: shading(points, shader) for name, shader in shaders.items()}
    # Processor time does not depend on other processes, but excludes the time of a GPU.
    clock = time.process_time if mi.variant().startswith("llvm") else time.perf_counter
    with _one_core():
        taken = seconds(work, repetitions, clock)
    unit = taken["slices", None] / count
    found = {(e.representation, n): e.error(n) for e in series for n in e.terms}
    result = [
        Method(
            case.name,
            name,
            terms,
            _transforms(spectrum),
            4 * int(np.prod(spectrum.neighbours)) * spectrum.table.words_per_node,
            spectrum.megabytes,
            spectrum.error if terms is None else found[name, terms],
            exact.delta_e(spectrum),
            taken[name, terms] / count / unit,
        )
        for (name, terms), spectrum in spectra.items()
    ]
    result.append(
        Method(case.name, _FFT, None, None, None, 0.0, None, (0.0, 0.0), 4 * taken[_FFT] / len(kappas) / unit)
    )
    for name, shader in shaders.items():
        assert isinstance(shader, TextureShader)
        result.append(
            Method(
                case.name,
                name,
                shader.textures.terms,
                shader.textures.terms,
                2 * shader.texel_reads,
                8e-6 * shader.textures.rows * shader.textures.columns * shader.textures.terms,
                None,
                shader_difference(shader, exact),
                taken[name] / shading_points / unit,
            )
        )
    return result


def _transforms(spectrum: GratingSpectrum) -> int:
    """Return the number of FFTs behind a table."""
    table = spectrum.table
    return table.values.shape[0] * table.values.shape[1] if isinstance(table, SliceTable) else len(table.terms)


def _spectra(case: Case, series: Sequence[SeriesErrors]) -> dict[tuple[str, int | None], GratingSpectrum]:
    """Return spectra by representation and number of terms: the numbers shown, and the one that `TOLERANCE` needs."""
    slices = case.spectrum(TOLERANCE)
    result: dict[tuple[str, int | None], GratingSpectrum] = {("slices", None): slices}
    for errors in series:
        kind, needed = errors.representation, errors.needed(TOLERANCE)
        whole = case.spectrum(TOLERANCE, kind, max(SHOWN_TERMS))
        assert isinstance(whole.table, AmplitudeTable)
        for count in sorted({*SHOWN_TERMS, needed}):
            first = dataclasses.replace(whole.table, terms=whole.table.terms[:count])
            # E is taken from the slices, as its computation takes time.
            result[kind, count] = dataclasses.replace(whole, table=first, energy=slices.energy_table())
    return result


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """Let Dr.Jit use one core in the block, as an FFT does."""
    before = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(before)


@dataclass(frozen=True)
class Found:
    """All results.

    Attributes:
        errors: eight for each tile.
        bounds: of the thesis, of Lagrange, and the error itself.
        methods: of the tiles that are timed.
    """

    errors: list[SeriesErrors]
    bounds: list[Bound]
    methods: list[Method]


def measure_terms(cases: Sequence[Case], timed: Sequence[str], progress: Progress = silent, **settings: int) -> Found:
    """Measure tiles under the current variant.

    Args:
        cases: the tiles.
        timed: names of those whose methods are timed.
        progress: called with (tiles done, tiles in total).
        settings: further arguments of `methods`.
    """
    errors: list[SeriesErrors] = []
    measured: list[Method] = []
    for done, case in enumerate(cases):
        progress(done, len(cases))
        own = list(series_errors(case))
        errors += own
        if case.name in timed:
            measured += methods(case, own, **settings)
    progress(len(cases), len(cases))
    return Found(errors, bounds(), measured)


BOUND_COLUMNS = {
    "n ≤ N": "{.exponent}",
    "thesis, as printed": "{.printed:.4g}",
    "e^x x^(N+1)/(N+1)!": "{.thesis:.4g}",
    "Lagrange, x^(N+1)/(N+1)!": "{.lagrange:.2g}",
    "error": "{.found:.2g}",
}


def terms_tables(found: Found) -> list[Table]:
    """Return the tables for a terminal."""
    bound_rows = [cells(BOUND_COLUMNS, bound) for bound in found.bounds]
    return [table(*error_table(found)), table(BOUND_COLUMNS, bound_rows), table(*method_table(found), texts=2)]


def method_table(found: Found) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of cost and accuracy, a row for each method."""
    columns = ["surface", "method", "FFTs", "words read", "MB", "∫|ΔS| dq", "ΔE00 mean, max", "time"]
    formats = {"transforms": "{}", "words": "{}", "megabytes": "{:.3g}", "error": "{:.0e}"}
    rows = []
    for method in found.methods:
        values = [(getattr(method, name), text) for name, text in formats.items()]
        numbers = ["—" if value is None else text.format(value) for value, text in values]
        colours = "{:.3f}, {:.3f}".format(*method.delta_e)
        rows.append([method.surface, method.label, *numbers, colours, f"{method.time_ratio:.3g}"])
    return columns, rows


def error_table(found: Found) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of ∫|ΔS| dq and max |Δη|/η, a row for each tile and number of terms."""
    curves = {(e.surface, e.representation, e.heights_from, e.precision): e for e in found.errors}
    kinds = list(dict.fromkeys(key[1:] for key in curves))
    columns = ["surface", "N", *(f"{kind}\n{origin}\n{precision}" for kind, origin, precision in kinds)]
    columns += [f"x^N/N!\n{origin}" for origin in ORIGINS]
    rows = []
    for surface, count in itertools.product(dict.fromkeys(key[0] for key in curves), SHOWN_TERMS):
        row = [surface, str(count)]
        some = [curves[(surface, *kind)] for kind in kinds]
        row += [f"{curve.error(count):.0e}, {curve.relative_error(count):.0e}" for curve in some]
        row += [f"{lagrange_bound(curves[surface, 'taylor', o, 'float64'].phase, count):.0e}" for o in ORIGINS]
        rows.append(row)
    return columns, rows


_COLOURS = {"taylor": "#c8281e", "chebyshev": "#1f6fb4"}
_DASHES = {"mean": "-", "lowest": (0, (4, 2))}
_BOUND_DASHES = {"mean": (0, (1, 1)), "lowest": (0, (1, 3))}
_WIDTHS = {"float32": 1.7, "float64": 0.8}
_SHOWN_ERRORS = 1e-15, 1e3


def plot_terms(found: Found) -> Figure:
    """Plot errors and bounds against the number of terms: ∫|ΔS| dq above, max |Δη|/η below, a column for each tile."""
    surfaces = list(dict.fromkeys(e.surface for e in found.errors))
    drawn = figure(2.6 * len(surfaces) + 0.6, 6.6)
    axes = drawn.subplots(2, len(surfaces), sharex=True, sharey="row", squeeze=False)
    for column, surface in zip(axes.T, surfaces, strict=True):
        curves = [e for e in found.errors if e.surface == surface]
        for curve in curves:
            style = {
                "color": _COLOURS[curve.representation],
                "linestyle": _DASHES[curve.heights_from],
                "linewidth": _WIDTHS[curve.precision],
            }
            label = f"{curve.representation}, heights from {curve.heights_from}, {curve.precision}"
            column[0].semilogy(curve.terms, curve.errors, label=label, **style)
            column[1].semilogy(curve.terms, curve.relative_errors, **style)
        _plot_bounds(column[0], curves)
        column[0].set_title(surface, fontsize=10, parse_math=False)
        for panel in column:
            panel.axvline(
                PUBLISHED_TERMS, color="0.7", linewidth=0.8, zorder=0, label=f"{PUBLISHED_TERMS} terms, published"
            )
            panel.set_ylim(*_SHOWN_ERRORS)
            panel.grid(alpha=0.25)
        column[1].set_xlabel("number of terms N")
    axes[0, 0].set_ylabel("∫|ΔS| dq")
    axes[1, 0].set_ylabel("max |Δη|/η of strong orders")
    drawn.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside lower center", ncols=max(1, len(surfaces) - 1), frameon=False, fontsize=9,
    )  # fmt: skip
    return drawn


def _plot_bounds(panel: Axes, curves: Sequence[SeriesErrors]) -> None:
    """Plot 2ε + ε² for Lagrange's ε of both origins, and for the ε that the thesis prints."""
    for curve in curves:
        if (curve.representation, curve.precision) == ("taylor", "float64"):
            values = [power_bound(lagrange_bound(curve.phase, n)) for n in curve.terms]
            label = f"Lagrange, heights from {curve.heights_from}"
            panel.semilogy(
                curve.terms, values, color="0.35", linewidth=1, linestyle=_BOUND_DASHES[curve.heights_from], label=label
            )
    lowest = next(curve.phase for curve in curves if curve.heights_from == "lowest")
    if math.isclose(lowest * VISIBLE[0] / THESIS_WAVELENGTH, THESIS_PHASE, rel_tol=1e-6):
        exponents, printed = zip(*THESIS_BOUNDS.items(), strict=True)
        panel.semilogy(
            [n + 1 for n in exponents], [power_bound(e) for e in printed],
            "x", color="black", markersize=5, label="thesis, at 400 nm",
        )  # fmt: skip
