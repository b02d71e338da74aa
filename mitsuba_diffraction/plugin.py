"""Registers the plugins with Mitsuba, for every variant, now and after each mi.set_variant.

Mitsuba discovers this module through the entry point group `mitsuba` (from 3.10 on) and reloads it at each change of
variant; importing `mitsuba_diffraction` does the same on every version.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import mitsuba as mi

from . import llvm
from .bsdf import diffraction_grating
from .bsdf.surface import hand_over
from .integrator import diffraction_path
from .shader import integrator
from .variants import is_spectral

# Name, the function of Mitsuba's that registers it, and what gives its class for the variant in force.
PLUGINS = (
    ("diffraction_grating", "register_bsdf", diffraction_grating.define),
    ("diffraction_path", "register_integrator", diffraction_path.define),
    ("diffraction_shader", "register_integrator", integrator.define),
)


def register(variant: str) -> None:
    """Make the plugins known to `variant`, or, where they cannot work, stand-ins that say why."""
    for name, function, define in PLUGINS:
        reason = None
        if not is_spectral(variant):
            reason = (
                f"{name} needs the wavelength of light, which the variant {variant} does not have: use a spectral "
                "variant, such as llvm_ad_spectral, cuda_ad_spectral or scalar_spectral"
            )
        elif variant.startswith("llvm"):
            reason = llvm.problem()
        getattr(mi, function)(name, _refusal(reason) if reason else define())


def _refusal(reason: str) -> Callable[[mi.Properties], mi.Object]:
    def refuse(props: mi.Properties) -> mi.Object:
        raise RuntimeError(reason)

    return refuse


def _accept_spectra() -> None:
    """Let mi.load_dict take a GratingSpectrum as a value, which Mitsuba's own function refuses."""
    original = mi.load_dict

    @functools.wraps(original)
    def load_dict(dict: dict, *args: object, **kwargs: object) -> object:
        return original(hand_over(dict), *args, **kwargs)

    mi.load_dict = load_dict


def _on_variant_change(old: str | None, new: str | None) -> None:
    if new is not None:
        register(new)


# A reload must not do this twice.
if not getattr(mi, "_mitsuba_diffraction_registered", False):
    mi.detail.add_variant_callback(_on_variant_change)
    _accept_spectra()
    mi._mitsuba_diffraction_registered = True
if mi.variant() is not None:
    register(mi.variant())
