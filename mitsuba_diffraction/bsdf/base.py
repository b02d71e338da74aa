"""The base under the surface, a nested BSDF; and construction of nested plugins."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..errors import RequestError


def nested_plugin(kind: str, **parameters: object) -> mi.Object:
    """Make a plugin without children.

    mi.load_dict replaces Mitsuba's file resolver during the call, while other threads construct plugins that may use
    it.
    """
    props = mi.Properties(kind)
    for name, value in parameters.items():
        props[name] = value
    return mi.PluginManager.instance().create_object(props)


def is_grating(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is of the class behind `diffraction_grating`."""
    return hasattr(bsdf, "layers")


def contains_grating(bsdf: mi.BSDF) -> bool:
    """Return whether a BSDF is a grating or one is nested in it."""
    return is_grating(bsdf) or any(map(contains_grating, nested(bsdf)))


def nested(bsdf: mi.BSDF) -> list[mi.BSDF]:
    """Return the BSDFs nested in a BSDF, such as both of a `twosided`."""

    class Children(mi.TraversalCallback):
        def __init__(self) -> None:
            mi.TraversalCallback.__init__(self)
            self.found: list[mi.BSDF] = []

        def put(self, name: str, value: object, *rest: object) -> None:
            if isinstance(value, mi.BSDF):
                self.found.append(value)

    callback = Children()
    bsdf.traverse(callback)
    return callback.found


TRANSMITS = (
    mi.BSDFFlags.DiffuseTransmission
    | mi.BSDFFlags.GlossyTransmission
    | mi.BSDFFlags.DeltaTransmission
    | mi.BSDFFlags.Null
)
REFLECTS = mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DeltaReflection


def base_from(props: mi.Properties) -> Base | None:
    """Return the nested BSDF of the parameter `base`, or None.

    Raises:
        RequestError: if it is not a BSDF that reflects and does not transmit, or has another name.
    """
    others = [name for name, value in props.objects() if name != "base" and isinstance(value, mi.BSDF)]
    if others:
        raise RequestError(
            'base: got a nested BSDF without this name, wanted <bsdf name="base" …> (in load_dict, the key "base")'
        )
    if "base" not in props:
        return None
    bsdf = props["base"]
    if not isinstance(bsdf, mi.BSDF):
        raise RequestError(f"base: got {bsdf!r}, wanted a BSDF")
    return Base(bsdf)


class Base:
    """A BSDF below the surface, which transmits its light twice.

    Attributes:
        bsdf: the BSDF itself.
        components: the flags of its components, as seen from the front.
        has_delta: whether it has specular reflection, which `eval` does not include.
    """

    def __init__(self, bsdf: mi.BSDF) -> None:
        flags = bsdf.flags()
        if flags & +TRANSMITS:
            raise RequestError(
                "base: got a BSDF that lets light through (transmission or a mask), wanted one that only reflects"
            )
        if not (flags & +mi.BSDFFlags.FrontSide and any(flags & +kind for kind in REFLECTS)):
            raise RequestError("base: got a BSDF that reflects nothing at its front, wanted one that reflects")
        self.bsdf = bsdf
        self.components = [bsdf.flags(i) & ~+mi.BSDFFlags.BackSide for i in range(bsdf.component_count())]
        self.has_delta = bool(flags & +mi.BSDFFlags.DeltaReflection)
        self._is_diffuse = bool(flags & +mi.BSDFFlags.DiffuseReflection)

    def context(self, ctx: mi.BSDFContext) -> mi.BSDFContext | None:
        """Return the context for the nested BSDF, whose components follow the grating's; None if none is requested."""
        if not any(
            flags & +mi.BSDFFlags.FrontSide and flags & +kind and ctx.is_enabled(kind, component)
            for component, flags in enumerate(self.components, 1)
            for kind in REFLECTS
        ):
            return None
        inner = mi.BSDFContext(ctx.mode)
        inner.type_mask = ctx.type_mask
        inner.component = ctx.component if ctx.component == mi.BSDFContext().component else ctx.component - 1
        return inner

    def albedo(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Estimate the albedo, averaged over the wavelengths, for the choice of samples."""
        if not self._is_diffuse:
            return mi.Float(1.0)
        value = mi.unpolarized_spectrum(self.bsdf.eval_diffuse_reflectance(si, active))
        return dr.clip(dr.mean(value), 0, 1)
