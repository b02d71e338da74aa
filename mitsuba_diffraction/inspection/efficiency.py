"""The efficiencies of the orders of a grating over angles and wavelengths, by either theory, as arrays and plots."""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..array_types import Real
from ..errors import RequestError, is_number
from ..files.outputs import MARK, METADATA
from ..files.writing import whole_file
from ..optics.media import Media, MediumBelow
from ..progress import Progress, silent
from ..rigorous.coordinate_transformation import is_profile
from ..settings import THEORIES
from ..surface.heightfield import HeightField
from .order_solver import IncidentLight, order_solver

if TYPE_CHECKING:
    from matplotlib.figure import Figure


POLARISATIONS = ("s", "p")
_MAX_ROWS, _MAX_COLUMNS = 24, 8  # of a printed table
_MAX_LINES, _MAX_MAPS = 7, 6  # of a plot
_MAX_PANELS = 4  # of lines: the angles or the wavelengths up to which there are no maps


@dataclass(frozen=True, eq=False)
class OrderEfficiencies:
    """The fraction of the incident power in each order of a grating.

    Attributes:
        values: (order, angle, wavelength, polarisation), s- before p-polarised incident light; 0 where an order does
            not propagate.
        orders: m, (n,), ascending; for a tile that varies along x and y (m_x, m_y), (n, 2); or names of peaks
            (`PeakEfficiencies`).
        angles: of incidence, degrees, (a,); in Littrow mounting one for each wavelength, (1, w).
        wavelengths: nm, in vacuum, (w,).
        source: description of the surface, material and theory.
    """

    values: Real
    orders: NDArray[np.int64] | NDArray[np.str_]
    angles: Real
    wavelengths: Real
    source: str

    @property
    def axes(self) -> dict[str, list]:
        """Return the names of the axes of `values` and the coordinates along them."""
        return {
            "order": [tuple(m) if isinstance(m, list) else m for m in self.orders.tolist()],
            "angle": ["Littrow"] if self.angles.ndim == 2 else self.angles.tolist(),
            "wavelength": self.wavelengths.tolist(),
            "polarisation": list(POLARISATIONS),
        }

    @property
    def incidence(self) -> Real:
        """The angle of incidence at each angle and wavelength, degrees, (a, w)."""
        return at_wavelengths(self.angles, len(self.wavelengths))

    @property
    def unpolarised(self) -> Real:
        """Return the mean of both polarisations, (order, angle, wavelength)."""
        return self.values.mean(axis=-1)

    def order(self, *m: int | str) -> Real:
        """Return the efficiencies of one order, (angle, wavelength, polarisation).

        Raises:
            ValueError: if it propagates nowhere, or is one number for a tile that varies along x and y.
        """
        orders = self.axes["order"]
        wanted = m[0] if len(m) == 1 else m
        if wanted not in orders:
            raise RequestError(f"order: got {wanted!r}, wanted one from {orders[0]} to {orders[-1]} that propagates")
        return self.values[orders.index(wanted)]

    def __str__(self) -> str:
        """Return a table for unpolarised light: a row for each angle and wavelength, a column for each strong order."""
        kept = np.sort(self._strongest(_MAX_COLUMNS))
        names = [_name(self.axes["order"][index]) for index in kept]
        width = max(8, *(len(name) + 2 for name in names))
        rows = [
            [f"{angle:.5g}°", f"{wavelength:g} nm", *(f"{100 * e:.3f}" for e in (*of_all[kept], of_all.sum()))]
            for of_angles, of_angle in zip(self.incidence, np.moveaxis(self.unpolarised, 0, -1), strict=True)
            for angle, wavelength, of_all in zip(of_angles, self.wavelengths, of_angle, strict=True)
        ]
        lines = [
            "".join(f"{cell:>{width}}" for cell in row) for row in [["angle", "λ", *names, "sum"], *rows[:_MAX_ROWS]]
        ]
        if len(rows) > _MAX_ROWS:
            lines.append(f"… {len(rows)} rows")
        if len(self.orders) > _MAX_COLUMNS:
            lines.append(f"the {_MAX_COLUMNS} strongest of {len(self.orders)} orders; the sum is of all")
        return "\n".join([f"{self.source}; unpolarised, % of the incident light", *lines])

    __repr__ = __str__

    def _strongest(self, count: int) -> NDArray[np.int64]:
        """Return the indices of the orders of the largest efficiencies, the strongest first, (count,) or fewer."""
        return np.argsort(-self.unpolarised.max(axis=(1, 2)), kind="stable")[:count]

    def save_csv(self, path: str | os.PathLike[str]) -> None:
        """Write a row for each order, angle and wavelength.

        Raises:
            FileNotFoundError: if the folder does not exist.
        """
        with whole_file(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as stream:
            rows = csv.writer(stream)
            names = ["order"] if self.orders.ndim == 1 else ["order_x", "order_y"]
            rows.writerow([*names, "angle_deg", "wavelength_nm", *POLARISATIONS, "unpolarised"])
            for order, a, w in np.ndindex(self.values.shape[:3]):
                pair = self.values[order, a, w]
                numbers = self.incidence[a, w], self.wavelengths[w], *pair, pair.mean()
                rows.writerow([*np.atleast_1d(self.orders[order]), *(f"{number:.9g}" for number in numbers)])
            stream.write(f"# {MARK}\n")

    def plot(self, path: str | os.PathLike[str] | None = None) -> Figure:
        """Plot the strongest orders: lines over wavelength or angle; where both are many, a map for each order.

        Returns the figure, and writes it as PNG, PDF or SVG if a path is given.
        """
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9, 5.2), dpi=120, layout="constrained")
        has_maps = min(len(self.angles), len(self.wavelengths)) > _MAX_PANELS
        (self._plot_maps if has_maps else self._plot_lines)(figure)
        figure.suptitle(self.source, fontsize=10, parse_math=False)
        if path is not None:
            with whole_file(path) as temporary:
                figure.savefig(temporary, metadata=METADATA)
        return figure

    def _plot_lines(self, figure: Figure) -> None:
        littrow = self.angles.ndim == 2
        over_wavelengths = littrow or len(self.angles) <= len(self.wavelengths)
        x, along = (self.wavelengths, 1) if over_wavelengths else (self.angles, 2)
        panels = figure.subplots(1, self.values.shape[along], sharey=True, squeeze=False)[0]
        if littrow:
            titles = ["Littrow mounting"]
        elif over_wavelengths:
            titles = [f"{angle:g}° incidence" for angle in self.angles]
        else:
            titles = [f"{wavelength:g} nm" for wavelength in self.wavelengths]
        for axes, title, values in zip(panels, titles, np.moveaxis(self.values, along, 0), strict=True):
            for number, index in enumerate(self._strongest(_MAX_LINES)):
                own = {"color": f"C{number}", "marker": "." if len(x) < 30 else None}
                axes.plot(x, values[index].mean(axis=-1), **own, label=f"order {_name(self.axes['order'][index])}")
                axes.plot(x, values[index, :, 0], "--", color=own["color"], lw=0.8)
                axes.plot(x, values[index, :, 1], ":", color=own["color"], lw=1)
            axes.plot(x, values.mean(axis=-1).sum(axis=0), color="0.6", label="all orders")
            axes.set_xlabel(_WAVELENGTH if over_wavelengths else _ANGLE)
            axes.set_title(title, fontsize=9)
        panels[0].set(ylabel="efficiency", ylim=(0, None))
        for style, name in (("k-", "unpolarised"), ("k--", "s-polarised"), ("k:", "p-polarised")):
            axes.plot([], [], style, lw=1, label=name)
        axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))

    def _plot_maps(self, figure: Figure) -> None:
        from matplotlib.colors import PowerNorm

        kept = self._strongest(_MAX_MAPS)
        columns = min(3, len(kept))
        grid = np.ravel(figure.subplots(-(-len(kept) // columns), columns, sharex=True, sharey=True, squeeze=False))
        scale = PowerNorm(0.5, 0, self.unpolarised[kept].max() or 1.0)  # shows weak orders, too
        for axes, index in zip(grid, kept, strict=False):
            of_order = self.unpolarised[index]
            shown = axes.pcolormesh(self.wavelengths, self.angles, of_order, norm=scale, shading="nearest")
            axes.set_title(f"order {_name(self.axes['order'][index])}", fontsize=9)
        for axes in grid[len(kept) :]:
            axes.set_axis_off()
        figure.supxlabel(_WAVELENGTH, fontsize=10)
        figure.supylabel(_ANGLE, fontsize=10)
        figure.colorbar(shown, ax=grid.tolist(), label="efficiency, unpolarised")


_WAVELENGTH, _ANGLE = "wavelength (nm)", "angle of incidence (°)"


def _name(order: int | str | tuple[int, int]) -> str:
    return f"{order:+d}" if isinstance(order, int) and order else str(order).replace(" ", "")


def efficiencies(
    height_field: HeightField,
    angles: ArrayLike | str,
    wavelengths: ArrayLike,
    *,
    theory: str = "scalar",
    material: str | None = None,
    int_ior: complex | str | None = None,
    transmission: str = "none",
    azimuth: float = 0.0,
    progress: Progress = silent,
) -> OrderEfficiencies:
    """Compute the efficiencies of the reflected or transmitted orders of a grating in air.

    Light is incident from above at the angle θ_i, from −x. An order at θ_m, positive towards −x, in a medium of index
    n_o has

        sin θ_i + n_o sin θ_m = m λ/T    (azimuth 0).

    Scalar theory: the efficiencies are the limit of the BSDF for narrow lobes, R K G E η_m(κ_m) or K_t G_t (1 − F) E
    η_m(κ_m), in float64 without tables (`scalar_theory`). Rigorous theory: they follow from Maxwell's equations
    (`rigorous.efficiencies`).

    Args:
        height_field: one period of a periodic surface; rigorous theory needs a profile, h(x).
        angles: of incidence, degrees, one or (a,), above −90 and below 90; or "littrow", the mounting in which order 1
            returns to the source, "littrow:m" of order m: sin θ_i = m λ/(2T). Transmitted light of that order is then
            deviated least by a sheet (Bragg's angle).
        wavelengths: nm, in vacuum, one or (w,).
        theory: "scalar" or "rigorous".
        material: a conductor by Mitsuba's name, "Al", or a file; or "none", the perfect mirror R = 1, in scalar theory.
        int_ior: or an index of refraction, n + ik, the name of a medium with dispersion, "BK7", or a file
            (`refractive_indices.index_of`); 1.5 if neither is given, as in a scene.
        transmission: "none": reflected orders; "interface": orders transmitted into the dielectric; "sheet": orders
            transmitted by a film with a flat lower face, n_o = 1, in rigorous theory with all internal reflections.
        azimuth: of the plane of incidence, degrees from the x axis; 90: along the grooves (conical incidence).
        progress: called with (steps done, steps in all).

    Raises:
        ValueError: if an argument is out of range; in scalar theory, if more than 1000 orders propagate; in rigorous
            theory, as `rigorous.efficiencies`.

    Warns:
        UserWarning: as `rigorous.efficiencies`.
    """
    if not isinstance(height_field, HeightField):
        raise RequestError(f"height_field: got {type(height_field).__name__}, wanted a HeightField")
    media = Media(MediumBelow.of(material, int_ior), transmission=transmission)
    return order_efficiencies(height_field, media, angles, wavelengths, azimuth, theory, progress)


def order_efficiencies(
    height_field: HeightField,
    media: Media,
    angles: ArrayLike | str,
    wavelengths: ArrayLike,
    azimuth: float,
    theory: str,
    progress: Progress,
) -> OrderEfficiencies:
    """Compute `efficiencies` of a grating in its media; the same arguments, errors and warnings."""
    wavelengths = checked_numbers("wavelengths", wavelengths, "nm from 10 to 100000 (100 µm)", 9.999, 100_000.001)
    angles = checked_angles(angles, wavelengths, height_field.tile_size[0], azimuth)
    incidence = at_wavelengths(angles, len(wavelengths))
    if theory not in THEORIES:
        raise RequestError(f"theory: got {theory!r}, wanted one of {', '.join(THEORIES)}")
    if not is_number(azimuth) or not np.isfinite(azimuth):
        raise RequestError(f"azimuth: got {azimuth!r}, wanted degrees")
    below, transmission = media.below, media.transmission
    below.check_theory(theory)
    if profile := is_profile(height_field):
        height_field = HeightField(height_field.heights[:1], height_field.pixel_size, height_field.source)
    n = np.maximum(below.index(wavelengths * 1e-3).real, 1) if media.transmits and below.index is not None else 1.0
    # The maximum of |q| is (n_i + n_o)/λ.
    solver = order_solver(theory, height_field, 1e-3 * float(np.min(2 * wavelengths / (1 + n))))
    solve = {"none": solver.reflected, "interface": solver.transmitted, "sheet": solver.through_sheet}[transmission]
    found: dict[tuple[int, ...], Real] = {}
    for step, (a, w) in enumerate(np.ndindex(incidence.shape), 1):
        wavelength = float(wavelengths[w]) * 1e-3
        orders = solve(IncidentLight(float(incidence[a, w]), azimuth, wavelength, below.index_at(wavelength)))
        for m, *pair in zip(orders.m, orders.s, orders.p, strict=True):
            of_order = found.setdefault(tuple(np.atleast_1d(m).tolist()), np.zeros((*incidence.shape, 2)))
            of_order[a, w] = pair
        progress(step, incidence.size)
    all_orders = sorted(found)
    return OrderEfficiencies(
        np.stack([found[m] for m in all_orders]),
        np.array(all_orders)[:, 0] if profile else np.array(all_orders),
        angles,
        wavelengths,
        description(height_field.source, media, azimuth, theory),
    )


def description(source: str, media: Media, azimuth: float, theory: str = "scalar") -> str:
    """Return the description of a surface in its media, and of the theory."""
    plane = f", plane of incidence at {azimuth:g}°" if azimuth else ""
    words = {"none": "", "interface": ", transmitted orders inside", "sheet": ", transmitted by a sheet"}
    return f"{source}; {media.below}, {theory} theory{words[media.transmission]}{plane}"


def checked_angles(angles: ArrayLike | str, wavelengths: Real, period: float, azimuth: float | Real) -> Real:
    """Return angles of incidence, degrees, (a,), or those of a Littrow mounting, one for each wavelength, (1, w).

    Args:
        angles: as in `efficiencies`.
        wavelengths: nm, (w,).
        period: along x, µm.
        azimuth: of the plane of incidence; 0 in Littrow mounting.

    Raises:
        ValueError: if the angles are out of range, or there is no such mounting.
    """
    if not isinstance(angles, str):
        return checked_numbers("angles", angles, "degrees above −90 and below 90", -90.0, 90.0)
    name, _, text = str(angles).partition(":")
    try:
        order = int(text or 1)
    except ValueError:
        order = 0
    if name != "littrow" or order == 0:
        raise RequestError(f"angles: got {angles!r}, wanted degrees, 'littrow' (order 1), or 'littrow:m' of an order m")
    if np.any(azimuth):
        raise RequestError(f"azimuth: got {azimuth} in Littrow mounting, wanted 0")
    sine = order * wavelengths / (2e3 * period)
    if (outside := np.abs(sine) >= 1).any():
        raise RequestError(
            f"wavelengths: got {wavelengths[outside][0]:g} nm, wanted below {2e3 * period / abs(order):g} nm: order "
            f"{order} of a period of {period:g} µm has no Littrow mounting there"
        )
    return np.rad2deg(np.arcsin(sine))[None, :]


def at_wavelengths(angles: Real, count: int) -> Real:
    """Return the angle of incidence at each angle and wavelength, (a, w), of what `checked_angles` returns."""
    return np.broadcast_to(angles if angles.ndim == 2 else angles[:, None], (len(angles), count))


def checked_numbers(name: str, values: ArrayLike, wanted: str, low: float, high: float) -> Real:
    """Return one number or several, all above `low` and below `high`, as (n,)."""
    try:
        array = np.atleast_1d(np.asarray(values, np.float64))
    except (TypeError, ValueError):
        raise RequestError(f"{name}: got {values!r}, wanted {wanted}") from None
    if array.ndim != 1 or not array.size:
        raise RequestError(f"{name}: got an array of shape {array.shape}, wanted one number or several")
    if not (inside := (low < array) & (array < high)).all():
        raise RequestError(f"{name}: got {array[~inside][0]:g}, wanted {wanted}")
    return array
