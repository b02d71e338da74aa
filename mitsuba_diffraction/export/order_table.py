"""The orders of a grating as a table (.csv), for any program."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from ..files.outputs import MARK
from ..files.writing import whole_file
from ..inspection.efficiency import at_wavelengths, checked_angles
from ..inspection.order_solver import IncidentLight
from ..progress import Progress, silent
from .exported_grating import DiffractedSide, ExportedGrating, checked_ranges

_COLUMNS = ["wavelength_nm", "theta_deg", "phi_deg", "side", "m", "n", "polarisation", "efficiency", "u", "v", "w"]
_JONES = ["to_s_re", "to_s_im", "to_p_re", "to_p_im"]
_HEADER = """\
{mark}: orders of a grating
{what}
{period}; z is the outer normal, the medium above is air
theta, phi: light of this polar angle in air travels along (sin theta cos phi, sin theta sin phi, -cos theta)
m, n: order along x and y; u, v, w: direction cosines along which the order travels, in its own medium of index N:
N (u, v) = (sin theta cos phi, sin theta sin phi) - wavelength (m, n)/period; w > 0 of reflected, w < 0 of transmitted
efficiency: power of the order over the power of the light; s: the electric field of the light is perpendicular to the
plane of incidence, along z x k, for theta = 0 along its limit (-sin phi, cos phi, 0); p: along k x (z x k); mean:
unpolarised light. Without the transmitted rows, what is left of one is absorbed\
"""
_AMPLITUDES = """
to_s, to_p: complex amplitudes of the s and p waves of the order for light of this row, in the same bases, k along the
order; their squared moduli add up to the efficiency; fields as exp(-i omega t), phases at the mean height\
"""


def write_order_table(
    grating: ExportedGrating,
    path: str | os.PathLike[str],
    wavelengths: ArrayLike,
    angles: ArrayLike | str,
    azimuths: ArrayLike = 0.0,
    progress: Progress = silent,
) -> int:
    """Write a row for each wavelength, direction of light, order and polarisation; return their number.

    The first lines, which begin with #, state the surface, units and conventions.

    Args:
        grating: the surface.
        path: of the file.
        wavelengths: nm, in vacuum, (w,).
        angles: polar angles of the light, degrees, (a,), or a Littrow mounting, as in `efficiencies`.
        azimuths: of the light, degrees, (b,).
        progress: called with (steps done, steps in all).

    Raises:
        ValueError: if an argument is out of range, or as `rigorous.efficiencies`.
    """
    wavelengths, _, azimuths = checked_ranges(wavelengths, 0.0, azimuths)
    incidence = at_wavelengths(checked_angles(angles, wavelengths, grating.period[0], azimuths), len(wavelengths))
    rigorous = grating.theory == "rigorous"
    x, y = grating.period
    period = f"period {x:.9g} um along x; grooves along y"
    if grating.height_field.shape[0] > 1:
        period = f"periods {x:.9g} and {y:.9g} um along x and y"
    header = (_HEADER + _AMPLITUDES * rigorous).format(mark=MARK, what=grating.description, period=period)
    count, shape = 0, (len(wavelengths), len(azimuths), len(incidence))
    with whole_file(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as stream:
        stream.writelines(f"# {line}\n" for line in header.splitlines())
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow([*_COLUMNS, *(_JONES if rigorous else [])])
        for step, (w, b, a) in enumerate(np.ndindex(shape), 1):
            wavelength = float(wavelengths[w]) * 1e-3
            angle = float(incidence[a, w])
            light = IncidentLight(angle, float(azimuths[b]), wavelength, grating.below.index_at(wavelength))
            of_light = [f"{number:.9g}" for number in (wavelengths[w], angle, azimuths[b])]
            for side in grating.diffracted(light):
                for row in _rows(side):
                    rows.writerow(of_light + row)
                    count += 1
            progress(step, int(np.prod(shape)))
    return count


def _rows(side: DiffractedSide) -> Iterator[list[str]]:
    """Yield the columns of the orders on one side, from "side" on."""
    for k, (m, direction) in enumerate(zip(side.m, side.directions, strict=True)):
        s, p = side.orders.s[k], side.orders.p[k]
        cosines = [_text(x) for x in direction]
        for column, (name, efficiency) in enumerate((("s", s), ("p", p), ("mean", (s + p) / 2))):
            row = [side.side, *map(str, m), name, f"{efficiency:.9g}", *cosines]
            if side.amplitudes is not None:
                pair = np.nan if name == "mean" else side.amplitudes[k, :, column]
                row += [_text(x) for x in np.broadcast_to(pair, 2).astype(np.complex128).view(np.float64)]
            yield row


def _text(number: float) -> str:
    """Return a cosine or an amplitude with nine decimals at most; none if there is none."""
    return "" if np.isnan(number) else f"{round(number, 9) + 0.0:.9g}"
