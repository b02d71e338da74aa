"""A clear plane layer over the grating: polycarbonate over a disc's metal, lacquer over foil.

A plane layer of index n preserves the tangential components of wave vectors, and with them q = −(ω_i + ω_o)_∥/λ.
Inside, sin θ' = sin θ/n and the wavelength is λ/n, hence κ' = 2πn (cos θ'_i + cos θ'_o)/λ and

    f = T_i T_o R' K' G' E' S(q; κ')/λ²,    T = 1 − F(θ)

where F is the power reflectance of the front face and R' the reflectance of the material relative to n; primed
quantities are those inside. The front face also reflects F specularly. Light that the grating diffracts beyond the
critical angle, or that the front face reflects back to the grating, is lost.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError, is_number
from .base import nested_plugin
from .tables import opaque

MIN_INDEX, MAX_INDEX = 0.01, 100.0
SAME_INDEX = 1e-3  # indices of refraction that differ by less, as those of air and vacuum, are taken as equal


def coat_from(props: mi.Properties) -> Coat | None:
    """Return the layer given by `coat_ior`, or None, also for one that has the index of the outside.

    Raises:
        RequestError: if its index is below one or below that of the outside.
    """
    if "coat_ior" not in props:
        return None
    coat = Coat(props["coat_ior"], props.get("ext_ior", "air"))
    return None if coat.relative < 1 + SAME_INDEX else coat


def absolute_index(name: str, index: float | str) -> float:
    """Return an index of refraction from a number or the name of a preset, as in Mitsuba's `dielectric`.

    Raises:
        RequestError: if it is neither.
    """
    if not isinstance(index, str):
        if not (is_number(index) and MIN_INDEX <= index <= MAX_INDEX):
            raise RequestError(
                f"{name}: got {index!r}, wanted a positive index of refraction, or a name such as 'bk7' "
                f"({MIN_INDEX:g} to {MAX_INDEX:g})"
            )
        index = float(index)
    try:
        interface = nested_plugin("dielectric", int_ior=index, ext_ior=1.0)
    except RuntimeError as error:
        known = str(error).partition("Valid choices are:")[2].strip()
        raise RequestError(f"{name}: got {index!r}, wanted a number or one of {known}") from None
    return float(np.ravel(mi.traverse(interface)["eta"])[0])


class Coat:
    """A clear plane layer.

    Attributes:
        index: n, absolute.
        relative, eta: n relative to the outside, as a number and as an array.
    """

    def __init__(self, index: float | str, outside: float | str) -> None:
        self.index = absolute_index("coat_ior", index)
        outer = absolute_index("ext_ior", outside)
        if self.index < max(1, (1 - SAME_INDEX) * outer):
            raise RequestError(f"coat_ior: got {self.index:g}, wanted at least one and that of the outside, {outer:g}")
        self.relative = max(self.index / outer, 1.0)
        self.eta = opaque(self.relative)

    def cos_inside(self, cos: mi.Float) -> mi.Float:
        """Return cos θ' for the cosine of an angle outside."""
        return dr.safe_sqrt(1 - (1 - dr.square(cos)) / dr.square(self.eta))

    def reflectance(self, cos: mi.Float) -> mi.Float:
        """Return F at the cosine of an angle outside."""
        return mi.fresnel(cos, self.eta)[0]
