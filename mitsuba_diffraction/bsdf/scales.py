"""The scales of the relief in a scene, `height_scale` and `lateral_scale`: a number or a texture each."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError, is_number
from ..settings import VISIBLE


class Scale:
    """A factor of lengths that may vary over the surface.

    Attributes:
        name: of the parameter.
        value: a number, or a texture of numbers.
        values: all of a texture, each once, ascending; interpolation stays between them.
    """

    def __init__(self, props: mi.Properties, name: str) -> None:
        """Read the parameter `name`.

        Raises:
            ValueError: if it is neither a number nor a texture whose values are known.
        """
        self.name, value = name, props.get(name, 1.0)
        if not is_number(value) and not isinstance(value, mi.Texture):
            raise RequestError(f"{name}: got {value!r}, wanted a number or a texture")
        self.value = value if isinstance(value, mi.Texture) else mi.Float(value)
        self.read()

    @property
    def varies(self) -> bool:
        """Whether it is a texture."""
        return isinstance(self.value, mi.Texture)

    def read(self) -> None:
        """Read the values, which the user may have changed.

        Raises:
            ValueError: if they cannot be known, as those of a mesh attribute, or are not finite.
        """
        found = [self.value]
        if self.varies:
            check_texture(self.name, self.value)
            parameters = mi.traverse(self.value)
            found = [parameters[key] for key in parameters.keys() if key.split(".")[-1] != "to_uv"]  # noqa: SIM118
            known = all(key.split(".")[-1] in ("data", "value", "to_uv") for key in parameters.keys())  # noqa: SIM118
            if not found or not known:
                raise RequestError(
                    f"{self.name}: got a {self.value.class_name()}, whose range is not known, wanted a number, bitmap "
                    "or checkerboard"
                )
        self.values = np.unique(np.concatenate([np.ravel(np.array(dr.detach(v), np.float64)) for v in found]))
        if not np.isfinite(self.values).all():
            raise RequestError(f"{self.name}: got values that are not finite, wanted numbers")

    def at(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Evaluate it at a point."""
        return self.value.eval_1(si, active) if self.varies else self.value

    def put(self, callback: mi.TraversalCallback) -> None:
        """Show it among the parameters of the scene."""
        callback.put(self.name, self.value, mi.ParamFlags.Differentiable)

    def __str__(self) -> str:
        low, high = self.values[[0, -1]]
        return f"{low:.6g} to {high:.6g}" if self.varies else str(self.value)


def check_texture(name: str, texture: mi.Texture) -> None:
    """Check the values of a bitmap that stands for a number.

    Raises:
        ValueError: if some are not finite, or they are colours.
    """
    parameters = mi.traverse(texture)
    if "data" not in parameters:
        return
    if not np.isfinite(np.array(dr.detach(parameters["data"]))).all():
        raise RequestError(f"{name}: got values that are not finite, wanted numbers")
    try:
        texture.eval_1(dr.zeros(mi.SurfaceInteraction3f))
    except RuntimeError:
        raise RequestError(f"{name}: got a picture in colour, wanted numbers: set its parameter raw to true") from None


class Scales:
    """Both scales of a scene.

    Attributes:
        height: of the heights.
        lateral: of the lengths along the surface; None where it is the number 1, which costs nothing.
    """

    def __init__(self, props: mi.Properties) -> None:
        self.height, lateral = Scale(props, "height_scale"), Scale(props, "lateral_scale")
        self.lateral = lateral if lateral.varies or lateral.values[0] != 1 else None

    def __iter__(self):
        return iter([self.height] if self.lateral is None else [self.height, self.lateral])

    @property
    def max_scale(self) -> float:
        """By how much shorter wavelengths the spectrum must reach than without scales."""
        return max(1.0, *(float(scale.values[-1]) for scale in self))

    def at(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return h/s and s at a point, h of the heights and s of lengths along the surface.

        Scaling lengths by s and heights by h is equivalent to scaling heights by h/s, at the wavelength λ/s and with
        lobes of the width s σ_q: nothing else knows of scales.
        """
        height = self.height.at(si, active)
        if self.lateral is None:
            return height, mi.Float(1.0)
        lateral = self.lateral.at(si, active)
        return height / lateral, lateral

    @property
    def min_lateral(self) -> float:
        """The smallest lateral scale."""
        return 1.0 if self.lateral is None else float(self.lateral.values[0])

    def ratios(self) -> tuple[float, float]:
        """Return the smallest and the largest height over lateral scale."""
        low, high = self.height.values[[0, -1]]
        max_lateral = 1.0 if self.lateral is None else self.lateral.values[-1]
        return float(low / max_lateral), float(high / self.min_lateral)

    def check(self, wavelengths: tuple[float, float], index: float, most: float | None) -> None:
        """Check the values against what a spectrum covers.

        Args:
            wavelengths: shortest and longest of the spectrum, nm.
            index: the largest index next to the relief.
            most: the lateral scale up to which orders do not overlap; None if they do.

        Raises:
            ValueError: naming the wavelengths from which to build.
        """
        shortest = VISIBLE[0] / index
        # At wavelengths that the spectrum does not cover the grating is black; κ and q are less at the others.
        covered = max(shortest / wavelengths[0], 1.0)
        for scale in self:
            if not scale.varies:
                dr.make_opaque(scale.value)
            low, high = scale.values[[0, -1]]
            if low < 0 or high > covered * (1 + 1e-6) or (low == 0 and scale is self.lateral):
                bad = low if low <= 0 else high
                raise RequestError(
                    f"{scale.name}: got {bad:.6g}, wanted {'0' if scale is self.height else 'more than 0 and up'} to "
                    f"{covered:.4g}: the spectrum was built for wavelengths from {wavelengths[0]:g} nm; for larger "
                    f"scales build it from {shortest:.4g} nm divided by the scale"
                    + (f", here {shortest / high:.4g} nm" if high > covered else "")
                )
        if self.lateral is not None and (most is None or self.lateral.values[-1] > most):
            raise RequestError(
                f"lateral_scale: got {self.lateral}, wanted 1"
                + ("" if most is None else f" or less than {most:.4g}")
                + ": only of orders that do not overlap the lobes keep their width (not of samples, of tiles as large "
                "as the coherence length, nor of line gratings with a coherence length below 15 um)"
            )
