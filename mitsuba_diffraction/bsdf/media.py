"""The media about the relief: what is outside, a coat, and whether light passes."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from ..errors import RequestError
from ..settings import TRANSMISSIONS
from .coat import SAME_INDEX, Coat, absolute_index, coat_from


@dataclass(frozen=True)
class Media:
    """What `ext_ior`, `coat_ior` and `transmission` of a scene say.

    Attributes:
        outside: absolute index of the medium above everything; one of air and vacuum.
        coat: the layer over the relief.
        transmission: "none", "interface" or "sheet".
        eta: index of the transparent material relative to the outside; None where no light passes.
    """

    outside: float
    coat: Coat | None
    transmission: str
    eta: float | None

    @classmethod
    def of(cls, props: mi.Properties) -> Media:
        """Return the media of a scene's parameters.

        Raises:
            RequestError: if an index is out of range, or light cannot pass.
        """
        coat = coat_from(props)
        exterior = absolute_index("ext_ior", props.get("ext_ior", "air"))
        outside = 1.0 if abs(exterior - 1) < SAME_INDEX else exterior
        kind = props.get("transmission", TRANSMISSIONS[0])
        if kind not in TRANSMISSIONS:
            raise RequestError(f"transmission: got {kind!r}, wanted one of {', '.join(TRANSMISSIONS)}")
        if kind == "none":
            return cls(outside, coat, kind, None)
        for name in ("material", "base", "coat_ior"):
            if name in props:
                got = repr(props[name]) if isinstance(props[name], str | float | int) else "a BSDF"
                raise RequestError(f"{name}: got {got} with transmission={kind}, wanted a dielectric (int_ior) alone")
        # As of `Dielectric`, in whose reflectance and in E it stands, too.
        eta = absolute_index("int_ior", props.get("int_ior", 1.5)) / exterior
        if abs(eta - 1) < SAME_INDEX:
            raise RequestError(f"int_ior: got that of the outside with transmission={kind}, wanted another one")
        return cls(outside, coat, kind, eta)

    @property
    def index(self) -> float:
        """The largest absolute index next to the relief, by which wavelengths are divided there."""
        return self.outside * (self.coat.relative if self.coat is not None else max(1.0, self.eta or 1.0))
