"""Registration of the plugins with Mitsuba, for every variant, now and after each mi.set_variant.

The class of a plugin is made when a scene first has one, as the modules that it needs take seconds to import.

Mitsuba 3.10 and later discover this module through the entry point group `mitsuba` and reload it on each change of
variant; importing `mitsuba_diffraction` has the same effect in all versions.
"""

from __future__ import annotations

import functools
import importlib

import drjit as dr
import mitsuba as mi

from ..machine import allowed_cores
from ..variants import is_supported, llvm_problem, use_threads
from .wrapped_functions import classes, making, wrap_functions

# Name, registration function of Mitsuba, and the module whose `define` makes the class for the current variant.
PLUGINS = (
    ("diffraction_grating", "register_bsdf", "bsdf.diffraction_grating"),
    ("diffraction_path", "register_integrator", "integrator.diffraction_path"),
    ("diffraction_shader", "register_integrator", "shader_2014.diffraction_shader"),
)


def register_plugins(variant: str) -> None:
    """Register the plugins for `variant`, or stand-ins that raise the reason why they cannot work."""
    for name, function, module in PLUGINS:
        reason = None
        if not is_supported(variant):
            lacks = "vectorised kernels" if "spectral" in variant else "the wavelength of light"
            reason = (
                f"{name} needs {lacks}, which the variant {variant} does not have: use llvm_ad_spectral, "
                "cuda_ad_spectral or their polarised forms"
            )
        elif variant.startswith("llvm"):
            reason = llvm_problem()
        make = functools.partial(_refuse, reason) if reason else functools.partial(_make, module, variant)
        getattr(mi, function)(name, make)


def _make(module: str, variant: str, props: mi.Properties) -> mi.Object:
    """Make a plugin, and before, if it is the first one of the variant, its class; called by several threads."""
    with making:
        if (module, variant) not in classes:
            classes[module, variant] = importlib.import_module(f"mitsuba_diffraction.{module}").define()
    return classes[module, variant](props)


def _refuse(reason: str, props: mi.Properties) -> mi.Object:
    raise RuntimeError(reason)


# A reload must not do this twice.
if not getattr(mi, "_mitsuba_diffraction_registered", False):
    wrap_functions([name for name, *_ in PLUGINS])
    mi._mitsuba_diffraction_registered = True
    # A container may allow fewer cores than Dr.Jit sees.
    use_threads(min(dr.thread_count(), allowed_cores()))
if mi.variant() is not None:
    register_plugins(mi.variant())
