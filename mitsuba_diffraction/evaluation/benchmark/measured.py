"""A synthetic material for Mitsuba's data-driven BSDF `measured` (Dupuy and Jakob 2018), to compare speeds with."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
from mitsuba.python.tensor_io import write

from ...settings import VISIBLE

_ANGLES, _RESOLUTION, _BANDS = 8, 32, 100


def measured_bsdf() -> mi.BSDF:
    """Return the BSDF of `write_measured`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "synthetic.bsdf"
        write_measured(path)
        return mi.load_dict({"type": "measured", "filename": str(path)})


def write_measured(path: Path) -> None:
    """Write a file for `measured` with the tables of a smooth isotropic lobe: 8 angles of incidence, 32², 100 bands.

    Its speed hardly depends on what the tables contain.
    """
    y, x = np.mgrid[:_RESOLUTION, :_RESOLUTION] / (_RESOLUTION - 1)
    lobe = np.exp(-4 * x**2) * (1 + 0.2 * np.cos(2 * np.pi * y))
    tint = np.linspace(0.5, 1, _BANDS)[:, None, None]

    def for_each_angle(table: np.ndarray) -> np.ndarray:
        return np.broadcast_to(table, (1, _ANGLES, *table.shape))

    tables = {
        "theta_i": np.linspace(0, np.pi / 2, _ANGLES),
        "phi_i": np.zeros(1),
        "wavelengths": np.linspace(*VISIBLE, _BANDS),
        "ndf": lobe,
        "sigma": 1 - 0.5 * x,
        "vndf": for_each_angle(lobe),
        "luminance": for_each_angle(lobe),
        "spectra": for_each_angle(tint * lobe),
    }
    numbers = {name: np.ascontiguousarray(table, np.float32) for name, table in tables.items()}
    description = np.frombuffer(b"synthetic", np.uint8)
    # The writer prints a line.
    with contextlib.redirect_stdout(None):
        write(str(path), description=description, jacobian=np.zeros(1, np.uint8), **numbers)
