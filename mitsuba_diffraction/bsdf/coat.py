"""A clear plane layer over the grating: polycarbonate over a disc's metal, lacquer over foil.

A plane layer of index n preserves the tangential components of wave vectors, and with them q = −(ω_i + ω_o)_∥/λ.
Inside, sin θ' = sin θ/n and the wavelength is λ/n, hence κ' = 2πn (cos θ'_i + cos θ'_o)/λ and

    f = T_i T_o R' K' G' E' S(q; κ')/λ²,    T = 1 − F(θ)

where F is the power reflectance of the front face and R' the reflectance of the material relative to n. Primed
quantities are measured inside the coat. The front face also reflects F specularly. Light that the grating diffracts
beyond the critical angle, or that the front face reflects back to the grating, is lost.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..optics.media import Media
from ..optics.refractive_indices import RefractiveIndex
from .device_tables import opaque
from .indices import Dispersion


class Coat:
    """A clear plane layer.

    Attributes:
        medium: n of the layer, absolute, over the wavelength.
        eta: n relative to the outside in the middle of visible light.
        dispersion: n relative to the outside over the wavelength; None if it is constant.
    """

    def __init__(self, medium: RefractiveIndex, media: Media) -> None:
        self.medium, self.eta = medium, opaque(media.coat_index)
        self.dispersion = None if medium.is_constant else Dispersion([medium], media.above.nominal.real)

    @classmethod
    def of(cls, media: Media) -> Coat | None:
        """Return the layer over a relief, if there is one."""
        return None if media.coat is None else cls(media.coat, media)

    def etas(self, si: mi.SurfaceInteraction3f) -> list[mi.Float]:
        """Return n of each wavelength, relative to the outside."""
        if self.dispersion is None:
            return [self.eta] * len(si.wavelengths)
        return [self.dispersion(wavelength).real for wavelength in si.wavelengths]

    def per_nominal(self, wavelength: mi.Float) -> mi.Float:
        """Return n of a layer with dispersion at a wavelength in nm, relative to n in the middle of visible light."""
        assert self.dispersion is not None
        return self.dispersion(wavelength).real / self.eta

    def cos_inside(self, si: mi.SurfaceInteraction3f, cos: mi.Float) -> mi.Float | mi.UnpolarizedSpectrum:
        """Return cos θ' for the cosine of an angle outside, with dispersion that of each wavelength."""
        eta = self.eta if self.dispersion is None else mi.UnpolarizedSpectrum(self.etas(si))
        return dr.safe_sqrt(1 - (1 - dr.square(cos)) / dr.square(eta))

    def reflectance(self, si: mi.SurfaceInteraction3f, cos: mi.Float) -> mi.UnpolarizedSpectrum:
        """Return F at the cosine of an angle outside."""
        return mi.UnpolarizedSpectrum([mi.fresnel(cos, eta)[0] for eta in self.etas(si)])
