"""What a scene may say of a grating whose efficiencies are rigorous: its material, and what only scalar theory has."""

from __future__ import annotations

import mitsuba as mi

from ..errors import RequestError
from ..rigorous.spectrum import RigorousSpectrum
from .reflectance import Conductor, PerfectMirror, reflectance_from

_SCALAR_ONLY = {
    "height_scale": "build the spectrum of the other depth",
    "base": "what passes the surface is not computed; leave it out",
    "shadowing": "it is part of the efficiencies; leave it out",
    "coat_ior": "the efficiencies are those in air; leave it out, or use theory=scalar",
    "fresnel": "it is part of the efficiencies; leave it out",
}


def material_from(props: mi.Properties) -> dict[str, str | float]:
    """`material` or `int_ior` as `precompute` takes them, by Mitsuba's names; an index relative to the outside.

    Raises:
        ValueError: if they are unknown, or the material is the perfect mirror.
    """
    found = reflectance_from(props, None)
    if isinstance(found, Conductor):
        return {"material": found.material}
    if isinstance(found, PerfectMirror):
        raise RequestError("material: got 'none', wanted a real one for theory=rigorous, such as 'Al'")
    # As many digits as a float32 has.
    return {"int_ior": float(f"{found.eta[0] if hasattr(found.eta, '__len__') else found.eta:.6g}")}


def check_parameters(props: mi.Properties, spectrum: RigorousSpectrum) -> InEfficiencies:
    """What a scene says beside a rigorous spectrum.

    Raises:
        ValueError: if it is of another material, or something that rigorous theory does not have; RuntimeError in
            polarised variants.
    """
    if mi.is_polarized:
        raise RuntimeError(
            f"theory: got rigorous in the variant {mi.variant()}, wanted a variant without polarisation: the table "
            "holds efficiencies of unpolarised light; theory=scalar has polarised light"
        )
    for name, advice in _SCALAR_ONLY.items():
        if name in props:
            got = "a BSDF" if name == "base" else repr(props[name])
            raise RequestError(f"{name}: got {got}, wanted none with theory=rigorous: {advice}")
    if any(name in props for name in ("material", "int_ior", "ext_ior")):
        wanted = material_from(props)
        if "material" in wanted:
            same = wanted["material"] == spectrum.material
        else:
            same = not spectrum.material and abs(wanted["int_ior"] - spectrum.int_ior) < 1e-3 * abs(spectrum.int_ior)
        if not same:
            raise RequestError(
                f"material: got {_named(wanted)}, but the rigorous spectrum is of {spectrum.material_name}: "
                "leave it out, or build the spectrum for this material"
            )
    return InEfficiencies(spectrum.material_name)


def _named(material: dict[str, str | float]) -> str:
    return " ".join(f"{name} {value}" for name, value in material.items())


class InEfficiencies(PerfectMirror):
    """R = 1 beside efficiencies that are those of the material."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __repr__(self) -> str:
        return f"{self.name}, in the efficiencies"
