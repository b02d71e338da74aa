"""What lies around a relief: the media above and below it, a coat, and what becomes of transmitted light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RequestError
from ..settings import TRANSMISSIONS, VISIBLE
from .refractive_indices import KnownRange, RefractiveIndex, constant, index_of, is_file

DEFAULT_INT_IOR = 1.5
"""Index of the dielectric below a relief by default."""
SAME_INDEX = 1e-3  # indices of refraction that differ by less, as for air and vacuum, are taken as equal

_NAMES = ("material", "int_ior")
_VACUUM = constant(1.0)


@dataclass(frozen=True)
class MediumBelow:
    """The medium below a relief: a dielectric, a medium that absorbs light, or the perfect mirror.

    Attributes:
        parameter: that names it, "int_ior" or "material", for messages alone; "eta" of a metal given by two spectra in
            a scene.
        index: n + ik; None of the perfect mirror, R = 1, and of two spectra, which may vary over the surface.
    """

    parameter: str
    index: RefractiveIndex | None

    @classmethod
    def of(cls, material: str | None = None, int_ior: complex | str | None = None) -> MediumBelow:
        """Return the medium of the parameters `material` and `int_ior`; a dielectric of `DEFAULT_INT_IOR` of neither.

        Args:
            material: a conductor by Mitsuba's name, a medium with dispersion, or a file; or "none", the perfect mirror.
            int_ior: a number n or n + ik, a medium with dispersion, or a file.

        Raises:
            RequestError: if both are given, or the medium is unknown or out of range.
            FileNotFoundError: if there is no such file.
        """
        if material is None:
            return cls("int_ior", index_of("int_ior", DEFAULT_INT_IOR if int_ior is None else int_ior))
        if int_ior is not None:
            raise RequestError(f"material: got {material!r} and int_ior {int_ior}, wanted one of the two")
        return cls("material", None if material == "none" else index_of("material", material))

    @classmethod
    def requested(cls, *tables: Mapping[str, Any]) -> MediumBelow:
        """Return the medium of the first table of parameters that has one; errors of `of`."""
        given = next((table for table in tables if not table.keys().isdisjoint(_NAMES)), {})
        return cls.of(given.get("material"), given.get("int_ior"))

    @property
    def transparent(self) -> bool:
        """Whether light that enters it is not absorbed."""
        return self.index is not None and not self.index.absorbs

    @property
    def known_ranges(self) -> tuple[KnownRange, ...]:
        """Where its index is known."""
        return () if self.index is None else (self.index.known_range(self.parameter),)

    def index_at(self, wavelength: float) -> complex:
        """Return n + ik at a wavelength in vacuum, µm; infinite of the perfect mirror.

        Raises:
            RequestError: outside of the table of the medium.
        """
        if self.index is None:
            return complex("inf")
        for known in self.known_ranges:
            known.check((wavelength * 1e3, wavelength * 1e3))
        return complex(self.index(wavelength))

    def check_theory(self, theory: str) -> None:
        """Refuse the perfect mirror in rigorous theory, where it has no fields inside.

        Raises:
            RequestError: if it is.
        """
        if self.index is None and theory == "rigorous":
            raise RequestError("material: got 'none', wanted a real one for theory=rigorous, such as 'Al'")

    def __str__(self) -> str:
        """Return it as titles name it."""
        if self.index is None:
            return "perfect mirror"
        return f"n = {self.index}" if self.index.is_constant else str(self.index)


@dataclass(frozen=True)
class Media:
    """A surface in its media, but for its films (`film_stack.Stack`), whose thickness may vary.

    Attributes:
        below: the medium below the relief.
        above: absolute index of the uppermost medium.
        coat: absolute index of a clear layer over the relief; None, too, for one of the index of the medium above.
        transmission: "none", "interface" or "sheet".

    Raises:
        RequestError: if the index of the coat is below that of the medium above, or there is no transmission.
    """

    below: MediumBelow
    above: RefractiveIndex = _VACUUM
    coat: RefractiveIndex | None = None
    transmission: str = TRANSMISSIONS[0]

    def __post_init__(self) -> None:
        if self.transmission not in TRANSMISSIONS:
            raise RequestError(f"transmission: got {self.transmission!r}, wanted one of {', '.join(TRANSMISSIONS)}")
        if self.coat is not None:
            n, above = self.coat.nominal.real, self.above.nominal.real
            if n < max(1, (1 - SAME_INDEX) * above):
                raise RequestError(f"coat_ior: got {n:g}, wanted at least one and that of the outside, {above:g}")
            if n < (1 + SAME_INDEX) * above:
                object.__setattr__(self, "coat", None)
        if not self.transmits:
            return
        if self.coat is not None:
            raise RequestError(f"coat_ior: got {self.coat} with transmission={self.transmission}, wanted no coat")
        if not self.below.transparent:
            wanted = f"with {self.below}, wanted a transparent medium"
            raise RequestError(f"transmission: got {self.transmission!r} {wanted}")
        if abs(self.eta - 1) < SAME_INDEX:
            wanted = f"that of the outside with transmission={self.transmission}, wanted another one"
            raise RequestError(f"{self.below.parameter}: got {wanted}")

    @property
    def transmits(self) -> bool:
        """Whether transmitted light is followed."""
        return self.transmission != "none"

    @property
    def outside(self) -> float:
        """Absolute index of the uppermost medium; one for air and vacuum."""
        n = self.above.nominal.real
        return 1.0 if abs(n - 1) < SAME_INDEX else n

    @property
    def coat_index(self) -> float:
        """Index of the coat relative to the medium above, in the middle of visible light; one without a coat."""
        return 1.0 if self.coat is None else max(self.coat.nominal.real / self.above.nominal.real, 1.0)

    @property
    def eta(self) -> float:
        """Index below relative to the uppermost medium, in the middle of visible light."""
        assert self.below.index is not None
        return self.below.index.nominal.real / self.above.nominal.real

    @property
    def index(self) -> float:
        """The maximum absolute index next to the relief at any visible wavelength, by which wavelengths are divided."""
        if self.transmits:
            assert self.below.index is not None
            return self.outside * max(1.0, self.eta * _rise(self.below.index))
        return self.outside * self.coat_index * (1.0 if self.coat is None else _rise(self.coat))

    @property
    def index_name(self) -> str:
        """The parameter that gives `index`."""
        if self.coat is not None:
            return "coat_ior"
        return self.below.parameter if self.transmits and self.eta > 1 else "ext_ior"

    @property
    def known_ranges(self) -> tuple[KnownRange, ...]:
        """Where the indices of the medium above and of the coat are known."""
        coats = () if self.coat is None else (self.coat.known_range("coat_ior", clear=True),)
        return self.above.known_range("ext_ior", clear=True), *coats

    def with_eta(self, eta: float) -> Media:
        """Return the media with another relative index below, without dispersion."""
        return replace(self, below=replace(self.below, index=constant(eta * self.above.nominal.real)))


def _rise(medium: RefractiveIndex) -> float:
    """Return the maximum index of a medium at visible wavelengths relative to its nominal one."""
    return float(medium(np.linspace(*VISIBLE, 100) * 1e-3).real.max() / medium.nominal.real)


def index_files(parameters: Mapping[str, Any]) -> dict[str, Path]:
    """Return the files that a medium below is read from, by the parameters `material` and `int_ior`."""
    return {name: Path(str(parameters[name])) for name in _NAMES if is_file(parameters.get(name))}
