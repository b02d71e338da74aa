"""The base under the surface, a nested BSDF; and gratings that are nested in others."""

from __future__ import annotations

import contextlib
import re
import weakref
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError, is_number
from ..settings import VISIBLE
from .mitsuba_internals import nested_plugin, parts

_CHECKED = 32  # points along u and v at which a base is checked
_MIN_SPECULAR = 0.04  # albedo of a base that reflects specularly, too, about that of a varnish

living: weakref.WeakSet[mi.BSDF] = weakref.WeakSet()  # the gratings of all scenes
left_out: ContextVar[bool] = ContextVar("left_out", default=False)  # whether gratings are evaluated as black


@contextlib.contextmanager
def gratings_left_out(applies: bool) -> Iterator[None]:
    """Evaluate gratings as black inside a `with` block, where their values are not used.

    Dr.Jit records a call for all BSDFs, also those that its mask excludes, and recording is most of the time of a small
    picture.
    """
    token = left_out.set(applies)
    try:
        yield
    finally:
        left_out.reset(token)


def is_grating(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is of the class behind `diffraction_grating`."""
    return hasattr(bsdf, "layers")


def gratings_in(bsdf: mi.BSDF | None) -> list[mi.BSDF]:
    """Return a BSDF, if it is a grating, and the gratings nested in it."""
    if bsdf is None:
        return []
    return [bsdf] * is_grating(bsdf) + [grating for part in parts(bsdf, mi.BSDF) for grating in gratings_in(part)]


def base_from(given: Any) -> Base:
    """Return the base given by a nested BSDF, a reflectance or a colour.

    Raises:
        RequestError: if it is not a BSDF that reflects and does not transmit, a reflectance or a colour.
    """
    return Base(given if isinstance(given, mi.BSDF) else _diffuse(given))


def _diffuse(value: Any) -> mi.BSDF:
    """Return a diffuse BSDF of a reflectance, or of a colour as in HTML, "#a0522d"."""
    if is_number(value) and 0 <= value <= 1:
        return nested_plugin("diffuse", reflectance=float(value))
    if isinstance(value, str) and re.fullmatch("#[0-9a-fA-F]{6}", value):
        pixel = mi.Bitmap(np.array([[list(bytes.fromhex(value[1:]))]], np.uint8))
        linear = np.ravel(pixel.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False))
        return nested_plugin("diffuse", reflectance=mi.ScalarColor3f(*map(float, linear)))
    raise RequestError(f"base: got {value!r}, wanted a BSDF, a reflectance from 0 to 1 or a colour such as #a0522d")


class Base:
    """A BSDF below the surface, which transmits its light twice.

    Attributes:
        bsdf: the BSDF itself.
        components: the flags of its components, as seen from the front.
        has_delta: whether it has specular reflection, which `eval` does not include.
    """

    def __init__(self, bsdf: mi.BSDF) -> None:
        flags = bsdf.flags()
        if flags & +mi.BSDFFlags.Transmission:
            raise RequestError(
                "base: got a BSDF that lets light through (transmission or a mask), wanted one that only reflects"
            )
        if not (flags & +mi.BSDFFlags.FrontSide and flags & +mi.BSDFFlags.Reflection):
            raise RequestError("base: got a BSDF that reflects nothing at its front, wanted one that reflects")
        self.bsdf = bsdf
        self.components = [bsdf.flags(i) & ~+mi.BSDFFlags.BackSide for i in range(bsdf.component_count())]
        self.has_delta = bool(flags & +mi.BSDFFlags.DeltaReflection)
        self._is_diffuse = bool(flags & +mi.BSDFFlags.DiffuseReflection)
        self._is_specular = bool(flags & +(mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.DeltaReflection))
        self.check()

    def check(self) -> None:
        """Check that no light is negative, at points and wavelengths spread over their ranges.

        Mitsuba's textures take any number when parameters change.

        Raises:
            RequestError: if the reflectance is negative.
        """
        u, v = dr.meshgrid(*[dr.linspace(mi.Float, 0, 1, _CHECKED, endpoint=False)] * 2)
        si = dr.zeros(mi.SurfaceInteraction3f, _CHECKED**2)
        si.uv, si.wi, si.n = mi.Point2f(u, v), mi.Vector3f(0, 0, 1), mi.Normal3f(0, 0, 1)
        si.sh_frame = mi.Frame3f(si.n)
        si.wavelengths = type(si.wavelengths)(dr.lerp(*VISIBLE, dr.arange(mi.Float, _CHECKED**2) / _CHECKED**2))
        found = np.array(dr.detach(dr.min(mi.unpolarized_spectrum(self.bsdf.eval_diffuse_reflectance(si)))))
        if not found.min() >= -1e-6:
            raise RequestError(f"base: got a reflectance of {found.min():g}, wanted 0 or more")

    def context(self, ctx: mi.BSDFContext) -> mi.BSDFContext | None:
        """Return the context for the nested BSDF, whose components follow the grating's; None if none is requested."""
        kinds = mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DeltaReflection
        if not any(
            flags & +mi.BSDFFlags.FrontSide and flags & +kind and ctx.is_enabled(kind, component)
            for component, flags in enumerate(self.components, 1)
            for kind in kinds
        ):
            return None
        inner = mi.BSDFContext(ctx.mode)
        inner.type_mask = ctx.type_mask
        inner.component = ctx.component if ctx.component == mi.BSDFContext().component else ctx.component - 1
        return inner

    def albedo(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Estimate the albedo, averaged over the wavelengths, for the choice of samples; zero only if there is none."""
        if not self._is_diffuse:
            return mi.Float(1.0)
        value = mi.unpolarized_spectrum(self.bsdf.eval_diffuse_reflectance(si, active))
        return dr.clip(dr.mean(value), _MIN_SPECULAR if self._is_specular else 0, 1)
