"""The parameters of a scene that apply to rigorous efficiencies, and those that only scalar theory has."""

from __future__ import annotations

import mitsuba as mi

from ..errors import RequestError
from ..rigorous.spectrum import RigorousSpectrum
from .coat import Coat
from .reflectance import Conductor, PerfectMirror, reflectance_from

_SCALAR_ONLY = {
    "height_scale": "build the spectrum of the other depth",
    "base": "what passes the surface is not computed; leave it out",
    "shadowing": "it is part of the efficiencies; leave it out",
    "fresnel": "it is part of the efficiencies; leave it out",
}


def settings_from(props: mi.Properties, coat: Coat | None) -> dict[str, str | float]:
    """`material` or `int_ior` as `precompute` takes them, by Mitsuba's names; an index relative to the outside.

    Raises:
        ValueError: if they are unknown, or the material is the perfect mirror.
    """
    found = reflectance_from(props, coat)
    if isinstance(found, Conductor):
        return {"material": found.material}
    if isinstance(found, PerfectMirror):
        raise RequestError("material: got 'none', wanted a real one for theory=rigorous, such as 'Al'")
    # As many digits as a float32 has.
    eta = float(found.eta[0] if hasattr(found.eta, "__len__") else found.eta) * (1 if coat is None else coat.relative)
    return {"int_ior": float(f"{eta:.6g}")}


def settings_of_medium(coat: Coat | None) -> dict[str, float | bool]:
    """What `precompute` needs to know of the coat and of the variant."""
    medium = {} if coat is None else {"ext_ior": float(f"{coat.relative:.6g}")}
    return {**medium, "polarised": True} if mi.is_polarized else medium


def check_parameters(props: mi.Properties, spectrum: RigorousSpectrum, coat: Coat | None) -> InEfficiencies:
    """What a scene says beside a rigorous spectrum.

    Raises:
        ValueError: if it is of another material, medium or kind of light, or says something that rigorous theory does
            not have.
    """
    if mi.is_polarized and spectrum.mueller is None:
        raise RequestError(
            f"theory: got a rigorous spectrum of unpolarised light in the variant {mi.variant()}, wanted one that was "
            "built with polarised=True"
        )
    for name, advice in _SCALAR_ONLY.items():
        if name in props:
            got = "a BSDF" if name == "base" else repr(props[name])
            raise RequestError(f"{name}: got {got}, wanted none with theory=rigorous: {advice}")
    medium = 1.0 if coat is None else coat.relative
    if abs(spectrum.ext_ior - medium) > 1e-3 * medium:
        raise RequestError(
            f"coat_ior: got {'none' if coat is None else f'{coat.index:g}'}, but the rigorous spectrum is of a grating "
            f"below a medium of index {spectrum.ext_ior:g}: build it with ext_ior={medium:.4g}"
        )
    # Over a coat, ext_ior is what lies above it.
    if any(name in props for name in ("material", "int_ior", *(["ext_ior"] if coat is None else []))):
        wanted = settings_from(props, coat)
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
