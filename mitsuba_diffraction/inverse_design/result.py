"""The result of a design: the relief, its predicted far field, and what errors of its making cost."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..array_types import Real
from ..optics.color import delta_E, lamp_to_linear_sRGB, linear_sRGB_to_XYZ
from ..optics.geometry import diffracted
from ..scalar_theory.closed_form import tile_powers, transmitted_orders
from ..scalar_theory.validity import scalar_error
from ..settings import lobe_width
from ..surface.heightfield import HeightField
from .far_field import lobes_in_bins
from .plate import Plate
from .target import is_coloured

_PIXEL = 1 / 4  # of the shortest wavelength, at most: resolves all frequencies that light reaches
_BYTES_PER_PIXEL = 620  # of the relief: as measured, of plates of 64 and of 256 texels
_BRIGHT = 0.1  # of the maximum of a target: what is brighter is in the target
_LOBE = 3.0  # standard deviations, of order 0
# Of its making: factors of the heights and of the tool's blur.
_ERRORS = {"depth −5 %": (0.95, 1.0), "depth +5 %": (1.05, 1.0), "blur −20 %": (1.0, 0.8), "blur +20 %": (1.0, 1.2)}


@dataclass(frozen=True, eq=False)
class Design:
    """A relief and the light that it sends into the bins of the picture, as fractions of all light that leaves it.

    Attributes:
        texels: their heights before the blur of the tool, (texels, texels) µm, rows ↔ +y.
        height_field: one period; rows ↔ +y, as in all height fields.
        plate: the request.
        wanted, predicted: fraction of the light in each bin, (w, bins, bins), rows ↔ +y; `wanted` sums to one at
            most. As the plate has them; `Plate.mirrored` says how they are seen.
        mirror: fraction in order 0, the mirror direction, (w,).
        changed: efficiency after an error of making, (w,), by its name: "depth +5 %", "blur −20 %", …
        interrupted: whether the search was interrupted.
    """

    texels: Real = field(repr=False)
    height_field: HeightField
    plate: Plate = field(repr=False)
    wanted: Real = field(repr=False)
    predicted: Real = field(repr=False)
    mirror: Real
    changed: Mapping[str, Real]
    interrupted: bool = False

    @classmethod
    def of(cls, heights: Real, plate: Plate, wanted: Real, interrupted: bool = False) -> Design:
        """Predict the far field of texels of the given heights, (texels, texels) µm."""
        field = _relief(heights, plate)
        predicted, mirror = _far_field(field, plate, plate.wavelengths, wanted.shape[1])
        changed = {}
        for name, (depth, blur) in _ERRORS.items():
            relief = _relief(depth * heights, plate, blur)
            changed[name] = _efficiency(_far_field(relief, plate, plate.wavelengths, wanted.shape[1])[0], wanted)
        return cls(heights, field, plate, wanted, predicted, mirror, changed, interrupted)

    @property
    def wavelengths(self) -> Real:
        """In nm, (w,)."""
        return self.plate.wavelengths

    @property
    def inside(self) -> NDArray[np.bool_]:
        """The bins of the target: those brighter than a tenth of its maximum, (w, bins, bins)."""
        return _inside(self.wanted)

    @property
    def efficiency(self) -> Real:
        """The fraction of the light in the target, (w,)."""
        return _efficiency(self.predicted, self.wanted)

    @property
    def usable(self) -> Real:
        """The fraction of the light that the target can use, (w,): one where no colour leaves any out."""
        return self.wanted.sum(axis=(1, 2))

    def in_picture(self, efficiency: Real, wavelengths: Real | None = None) -> Real:
        """Return the fraction in the picture of the light that it can use, (w,), from the fraction of all light.

        At other `wavelengths` than those of the design, nm, its targets are those of the nearest ones.
        """
        usable = self.usable if wavelengths is None else self.usable[self._nearest(wavelengths)]
        return np.minimum(efficiency, usable) / usable

    @property
    def light(self) -> float:
        """The fraction in the picture of the light that it can use, over all wavelengths."""
        return float(np.minimum(self.efficiency, self.usable).sum() / self.usable.sum())

    @property
    def coloured(self) -> bool:
        """Whether wavelengths have different targets."""
        return is_coloured(self.wanted)

    @property
    def contrast(self) -> float:
        """The mean of (L − L₀)/(L + L₀), L and L₀ the mean radiances in the target and beside it in the frame."""
        pairs = zip(self.predicted, self.inside, strict=True)
        judged = self._judged
        radiances = [(p[i & judged].mean(), np.mean(p[~i & judged]) if (~i & judged).any() else 0.0) for p, i in pairs]
        return float(np.mean([(bright - dark) / (bright + dark) for bright, dark in radiances]))

    @property
    def correlation(self) -> Real:
        """Pearson's correlation of wanted and predicted light over the bins, (w,)."""
        pairs, judged = zip(self.wanted, self.predicted, strict=True), self._judged
        return np.array([np.corrcoef(t[judged], p[judged])[0, 1] for t, p in pairs])

    @property
    def _judged(self) -> NDArray[np.bool_]:
        """The bins of the frame, (bins, bins); without the bins of order 0, if the plate sends unused light there."""
        edges = self.plate.edges(self.wanted.shape[1])
        middles = (edges[1:] + edges[:-1]) / 2
        lobe = _LOBE * float(self.wavelengths.max()) * 1e-3 * lobe_width(self.plate.coherence_length)
        return np.hypot(*np.meshgrid(middles, middles)) > (lobe if self.plate.unused == "mirror" else -1.0)

    @property
    def unevenness(self) -> Real:
        """The standard deviation of predicted by wanted light over the target, relative to its mean, (w,)."""
        ratios = [p[i] / t[i] for p, t, i in zip(self.predicted, self.wanted, self.inside, strict=True)]
        return np.array([ratio.std() / ratio.mean() for ratio in ratios])

    def colours(self, light: Real) -> Real:
        """Return linear sRGB, (bins, bins, 3), of light in the bins, (w, bins, bins); the brightest channel of the
        target is 1. Grey for a laser.
        """
        matrix = lamp_to_linear_sRGB(self.wavelengths)
        return np.moveaxis(light, 0, -1) @ matrix / (np.moveaxis(self.wanted, 0, -1) @ matrix).max()

    @property
    def seen(self) -> tuple[Real, Real]:
        """Linear sRGB of target and prediction, equally bright, as they are seen, rows from the bottom."""
        target, predicted = (self.colours(light) for light in (self.wanted, self.predicted))
        bright, found = (linear_sRGB_to_XYZ(colours)[self._judged, 1].sum() for colours in (target, predicted))
        columns = slice(None, None, -1 if self.plate.mirrored else 1)
        return target[:, columns], predicted[:, columns] * bright / found

    @property
    def colour_difference(self) -> float:
        """The mean CIEDE2000 of target and prediction, equally bright, over the frame; NaN for a laser."""
        if np.ptp(self.wavelengths) < 2:
            return math.nan
        return float(delta_E(*map(linear_sRGB_to_XYZ, self.seen))[self._judged].mean())

    @property
    def warning(self) -> str:
        """A sentence if the relief is outside the range of scalar theory, otherwise ""."""
        return scalar_error(self.height_field, light=(self.wavelengths.min(), self.wavelengths.max())).warning

    def efficiencies(self, wavelengths: Real) -> Real:
        """Return the fraction of the light in the target at other wavelengths in nm, (n,).

        At each wavelength the target of the nearest wavelength of the design is used.
        """
        predicted = _far_field(self.height_field, self.plate, wavelengths, self.wanted.shape[1])[0]
        return _efficiency(predicted, self.wanted[self._nearest(wavelengths)])

    def _nearest(self, wavelengths: Real) -> NDArray[np.intp]:
        return np.abs(np.subtract.outer(wavelengths, self.wavelengths)).argmin(axis=1)


def _pixels_per_texel(plate: Plate) -> int:
    """Return the number of pixels of at most `_PIXEL` along a texel; inside a sheet wavelengths are shorter."""
    index = 1.0 if plate.int_ior is None else float(plate.index(plate.wavelengths * 1e-3).max())
    pixel = _PIXEL * plate.light[0] * 1e-3 / index
    return max(4, math.ceil(plate.texel / pixel))


def memory_of_prediction(plate: Plate) -> float:
    """Return the bytes that `Design.of` takes, about; the search takes less."""
    return _BYTES_PER_PIXEL * float(plate.texels * _pixels_per_texel(plate)) ** 2


def _relief(heights: Real, plate: Plate, blur_scale: float = 1.0) -> HeightField:
    """Return one period of the relief."""
    per_texel = _pixels_per_texel(plate)
    spread = plate.spread(per_texel, blur_scale)
    source = f"design of {plate.texels} × {plate.texels} texels of {plate.texel:g} µm"
    return HeightField(spread @ heights @ spread.T, plate.texel / per_texel, source)


def _far_field(relief: HeightField, plate: Plate, wavelengths: Real, bins: int) -> tuple[Real, Real]:
    """Return the fractions of the light in the bins, (w, bins, bins), and in order 0, (w,).

    Orders have the powers of the BSDF, each at its own κ, with K G or, for a sheet, K_t G_t (1 − F).
    """
    powers = tile_powers(relief, float(wavelengths.min()) * 1e-3)
    edges, predicted, mirror = plate.edges(bins), [], []
    for wavelength in wavelengths * 1e-3:
        if plate.int_ior is None:
            axis = np.arange(-int(plate.period / wavelength), int(plate.period / wavelength) + 1)
            m = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
            found = diffracted(np.zeros(2), m * wavelength / plate.period)
            m = m[found.kept]
            power = found.k_g * powers(m, 2 * np.pi * found.v_z / wavelength)
        else:
            orders = transmitted_orders(
                powers, 2 * (plate.period,), wavelength, 0.0, float(plate.index(wavelength)), sheet=True
            )
            m, power = orders.m, orders.unpolarised
        power = power / power.sum()
        # P = A η Aᵀ, as in `far_field`; the memory for a lobe of each order would be many gigabytes.
        max_order = int(np.abs(m).max())
        of_orders = np.zeros((2 * max_order + 1, 2 * max_order + 1))
        of_orders[m[:, 1] + max_order, m[:, 0] + max_order] = power
        axis = np.arange(-max_order, max_order + 1)
        lobes = lobes_in_bins(edges, axis, plate.period, wavelength, plate.coherence_length)
        predicted.append(lobes @ of_orders @ lobes.T)
        mirror.append(power[(m == 0).all(axis=-1)].sum())
    return np.array(predicted), np.array(mirror)


def _inside(wanted: Real) -> NDArray[np.bool_]:
    return wanted > _BRIGHT * wanted.max(axis=(1, 2), keepdims=True)


def _efficiency(predicted: Real, wanted: Real) -> Real:
    return np.where(_inside(wanted), predicted, 0).sum(axis=(1, 2))
