"""Registration of the plugins with Mitsuba, for every variant, now and after each mi.set_variant.

Mitsuba 3.10 and later discover this module through the entry point group `mitsuba` and reload it on each change of
variant; importing `mitsuba_diffraction` has the same effect in all versions.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi

from . import llvm
from .bsdf.base import living
from .bsdf.light import cover_light
from .bsdf.parameters import hand_over
from .errors import Bug, RequestError, root_cause
from .llvm import is_supported

# Name, registration function of Mitsuba, and the module whose `define` makes the class for the current variant.
PLUGINS = (
    ("diffraction_grating", "register_bsdf", "bsdf.diffraction_grating"),
    ("diffraction_path", "register_integrator", "integrator.diffraction_path"),
    ("diffraction_shader", "register_integrator", "evaluation.realtime_shader.diffraction_shader"),
)


def register_plugins(variant: str) -> None:
    """Register the plugins for `variant`, or stand-ins that raise the reason why they cannot work."""
    for name, function, module in PLUGINS:
        define = importlib.import_module(f".{module}", __package__).define
        reason = None
        if not is_supported(variant):
            lacks = "vectorised kernels" if "spectral" in variant else "the wavelength of light"
            reason = (
                f"{name} needs {lacks}, which the variant {variant} does not have: use llvm_ad_spectral, "
                "cuda_ad_spectral or their polarised forms"
            )
        elif variant.startswith("llvm"):
            reason = llvm.problem()
        getattr(mi, function)(name, functools.partial(_refuse, reason) if reason else define())


def _refuse(reason: str, props: mi.Properties) -> mi.Object:
    raise RuntimeError(reason)


def _with_short_errors(load: Callable[..., mi.Object]) -> Callable[..., mi.Object]:
    """Return a loader that accepts a GratingSpectrum in a dict, and reports errors of the plugins in one line.

    The gratings of a scene are made to cover its light.
    """

    @functools.wraps(load)
    def loader(scene: dict | str, *args: object, **kwargs: object) -> mi.Object:
        try:
            return _with_light(load(hand_over(scene), *args, **kwargs))
        except RequestError as error:
            line = str(error)
        except RuntimeError as error:
            if not any(f'plugin of type "{name}"' in str(error) for name, *_ in PLUGINS):
                raise
            try:
                line = root_cause(error)
            except Bug:
                raise error from None  # with its traceback
        raise RuntimeError(line)

    return loader


def _with_light(loaded: mi.Object) -> mi.Object:
    """Return a scene whose gratings cover its light; if they cannot, only this frame has referred to it."""
    if isinstance(loaded, mi.Scene):
        cover_light(loaded)
    return loaded


_count = 0  # of gratings at the last picture


@contextlib.contextmanager
def _garbage_withheld() -> Iterator[None]:
    """Collect garbage before a picture is traced, if there are more gratings than at the last one, but not inside.

    Dr.Jit calls all gratings in the kernels of all scenes, and where Python frees a BSDF while Dr.Jit traces, the
    process dies (Mitsuba 3.9.1, any BSDF). Python's collector, which runs because a grating is Python code, frees
    scenes that stand in reference cycles of the user.
    """
    global _count
    was_enabled = gc.isenabled()
    if was_enabled and len(living) > _count:
        gc.collect()
    _count = len(living)
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _with_light_covered(render: Callable[..., mi.TensorXf]) -> Callable[..., mi.TensorXf]:
    """Return `mi.render`, for sensors that are not in the scene, and lights that changed since it was loaded.

    Garbage is not collected while it traces.
    """

    @functools.wraps(render)
    def renderer(
        scene: mi.Scene, params: object = None, sensor: mi.Sensor | int = 0, *args: object, **kwargs: object
    ) -> mi.TensorXf:
        if isinstance(scene, mi.Scene):
            cover_light(scene, sensor)
        with _garbage_withheld():
            return render(scene, params, sensor, *args, **kwargs)

    return renderer


# A reload must not do this twice.
if not getattr(mi, "_mitsuba_diffraction_registered", False):
    for name in ("load_dict", "load_file", "load_string"):
        setattr(mi, name, _with_short_errors(getattr(mi, name)))
    mi.render = _with_light_covered(mi.render)
    mi._mitsuba_diffraction_registered = True
    # With one thread, on a machine of one core, Mitsuba 3.9.1 hangs when it reads or writes an EXR picture.
    if dr.thread_count() < 2:
        dr.set_thread_count(2)
if mi.variant() is not None:
    register_plugins(mi.variant())
