"""The lights supported by a real-time shader: directional and point lights."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..bsdf.mitsuba_internals import DIRECTIONAL, POINT
from ..bsdf.testing import array, interaction
from ..errors import RequestError
from .tristimulus import wavelengths


def per_nanometre(evaluate: Callable[[mi.SurfaceInteraction3f], mi.UnpolarizedSpectrum]) -> NDArray[np.float64]:
    """Evaluate a spectral function of a SurfaceInteraction3f at `tristimulus.wavelengths`: (401,)."""
    nanometres, channels = wavelengths(), len(mi.UnpolarizedSpectrum(0))
    groups = np.resize(nanometres, (-(-nanometres.size // channels), channels))
    values = array(evaluate(interaction((0, 0, 1), groups)), np.float64).reshape(channels, -1)
    return np.broadcast_to(values, (channels, len(groups))).T.ravel()[: nanometres.size]


class Light:
    """A directional or point emitter of a scene.

    Attributes:
        emitter: the Mitsuba emitter.
        irradiance: (401,) at `tristimulus.wavelengths`: at normal incidence, per nm, for point lights at distance one.
    """

    KINDS = (DIRECTIONAL, POINT)

    def __init__(self, emitter: mi.Emitter) -> None:
        self.emitter = emitter
        self.at_point = emitter.class_name() == POINT
        # At distance one from a point light; directional light is uniform.
        origin = mi.Point3f(mi.traverse(emitter)["position"]) if self.at_point else mi.Point3f(0)

        def at_normal_incidence(si: mi.SurfaceInteraction3f) -> mi.UnpolarizedSpectrum:
            si.p = origin + mi.Vector3f(0, 0, 1)
            _, value = emitter.sample_direction(si, mi.Point2f(0.5), True)
            return mi.unpolarized_spectrum(value)

        self.irradiance = per_nanometre(at_normal_incidence)

    def sample(
        self, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Float, mi.UnpolarizedSpectrum]:
        """Return direction of the light, factor of `irradiance`, and irradiance at the wavelengths of the ray."""
        ds, value = self.emitter.sample_direction(si, mi.Point2f(0.5), active)
        falloff = dr.rcp(dr.square(ds.dist)) if self.at_point else mi.Float(1)
        return ds, falloff, mi.unpolarized_spectrum(value)


def lights_of(scene: mi.Scene) -> list[Light]:
    """Return the directional and point lights of a scene; others are ignored.

    Raises:
        ValueError: if there is none.
    """
    found = [Light(emitter) for emitter in scene.emitters() if emitter.class_name() in Light.KINDS]
    if not found:
        raise RequestError(
            "diffraction_shader: the scene has no directional or point light, and no others are supported; replace a "
            "sun with a disc by a directional light"
        )
    return found
