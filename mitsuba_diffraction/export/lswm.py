"""A grating for the Lumerical Sub-Wavelength Model (.json), by which Zemax OpticStudio and Speos read gratings.

The fields are those of the legacy format as Ansys' public scripts write them (simutechphotonics/lum_speos_optimization,
Copyright Ansys 2023); arrays are encoded as Lumerical's other JSON files: {"_type": "matrix", "_size", "_complex",
"_data"}, the first index fastest, real and imaginary parts in turn. Lengths are in metres, angles in degrees.

Light of (theta, phi), from either side, has the tangential wave vector n k_0 sin θ (cos φ, sin φ), n the index of its
medium; order (n_1, n_2) adds n_1 and n_2 times the reciprocal lattice vectors 2π/T. The amplitudes are those of
unit vectors ŝ = −ẑ × k̂/|ẑ × k̂| and p̂ = k̂ × ŝ; their squared moduli are fractions of the incident power.
"""

from __future__ import annotations

import json
import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..files.outputs import MARK
from ..files.writing import whole_file
from ..inspection.order_solver import IncidentLight
from ..progress import Progress, silent
from .exported_grating import DiffractedSide, ExportedGrating, checked_ranges

_DIGITS = 9
_SIDES = (("R", "reflected"), ("T", "transmitted"))


def write_lswm(
    grating: ExportedGrating,
    path: str | os.PathLike[str],
    wavelengths: ArrayLike,
    angles: ArrayLike,
    azimuths: ArrayLike,
    progress: Progress = silent,
) -> None:
    """Write the amplitudes of all orders for light from above and, of a dielectric, from below.

    Scalar theory has no phases: its amplitudes are the roots of efficiencies, without change of polarisation. An
    absorbing material has no light from below; its amplitudes are zero.

    Args:
        grating: the surface.
        path: of the file.
        wavelengths: nm, in vacuum, (w,).
        angles: polar angles of the light in its medium, degrees, (a,).
        azimuths: of the light, degrees, (b,).
        progress: called with (steps done, steps in all).

    Raises:
        ValueError: if an argument is out of range, or as `rigorous.efficiencies`.
    """
    wavelengths, angles, azimuths = checked_ranges(wavelengths, angles, azimuths)
    shape = len(angles), len(azimuths), len(wavelengths)
    steps = int(np.prod(shape)) * (2 if grating.transmits else 1)
    done = 0
    results = {}
    for name, from_below in (("lower", True), ("upper", False)):
        found: dict[str, dict[tuple[int, ...], NDArray[np.complex128]]] = {key: {} for key, _ in _SIDES}
        for a, b, w in np.ndindex(shape):
            if from_below and not grating.transmits:
                break
            wavelength = float(wavelengths[w]) * 1e-3
            index = grating.below.index_at(wavelength)
            light = IncidentLight(float(angles[a]), float(azimuths[b]), wavelength, index, from_below)
            for (key, _), side in zip(_SIDES, grating.diffracted(light), strict=False):
                for order, matrix in zip((-side.m).tolist(), _amplitudes(side), strict=True):
                    of_order = found[key].setdefault(tuple(order), np.zeros((*shape, 2, 2), np.complex128))
                    of_order[a, b, w] = matrix
            done += 1
            progress(done, steps)
        results[f"grat_results_{name}"] = {
            "wavelength": (wavelengths * 1e-9).tolist(),
            "angle_definition": {"theta": angles.tolist(), "phi": azimuths.tolist()},
            **_of_sides(found, shape),
            "lossless": grating.transmits,
        }
    x, y = (2 * np.pi / (length * 1e-6) for length in grating.period)
    middle = grating.below.index_at(float(np.median(wavelengths)) * 1e-3)
    content = {
        "description": f"{MARK}: {grating.description}",
        "n_lower": middle.real if np.isfinite(middle.real) else 1.0,
        "n_upper": 1.0,
        "reciprocal_lattice_vector_1": [x, 0.0],
        "reciprocal_lattice_vector_2": [0.0, y],
        **results,
        "speos": {"detect_ray_direction_from_surface_normal": False},
    }
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content) + "\n", encoding="utf-8")


def _amplitudes(side: DiffractedSide) -> NDArray[np.complexfloating]:
    """Return the amplitudes of the orders, (n, 2, 2)."""
    if side.amplitudes is not None:
        return side.amplitudes
    roots = np.sqrt(np.stack([side.orders.s, side.orders.p], axis=-1))
    return roots[:, None, :] * np.eye(2, dtype=np.complex128)


def _of_sides(
    found: dict[str, dict[tuple[int, ...], NDArray[np.complex128]]], shape: tuple[int, int, int]
) -> dict[str, Any]:
    """Return the fields of reflected and transmitted orders; of no orders, order 0 without light."""
    fields: dict[str, Any] = {}
    for key, of_orders in found.items():
        of_orders = of_orders or {(0, 0): np.zeros((*shape, 2, 2), np.complex128)}
        orders = sorted(of_orders)
        fields[f"list_orders_{key}"] = _matrix(np.array(orders))
        fields[key] = _matrix(np.stack([of_orders[order] for order in orders], axis=3))
    return fields


def _matrix(values: NDArray[Any]) -> dict[str, Any]:
    """Return an array in Lumerical's encoding."""
    flat, is_complex = values.ravel(order="F"), np.iscomplexobj(values)
    if is_complex:
        flat = np.stack([flat.real, flat.imag], axis=1).ravel()
    numbers = np.round(flat, _DIGITS) + 0.0
    data = numbers.tolist()
    return {"_type": "matrix", "_size": list(values.shape), "_complex": bool(is_complex), "_data": data}
