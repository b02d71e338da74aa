"""What lies around a relief."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import RequestError
from .materials import KnownRange, RefractiveIndex, index_of, is_file

DEFAULT_INT_IOR = 1.5
"""Index of the dielectric below a relief of which nothing else is said."""

_NAMES = ("material", "int_ior")


@dataclass(frozen=True)
class MediumBelow:
    """The medium below a relief: a dielectric, a medium that absorbs light, or the perfect mirror.

    Attributes:
        parameter: that names it, "int_ior" or "material", for messages alone.
        index: n + ik; None of the perfect mirror, R = 1.
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
    def known(self) -> tuple[KnownRange, ...]:
        """Where its index is known."""
        return () if self.index is None else (self.index.known(self.parameter),)

    def at(self, wavelength: float) -> complex:
        """Return n + ik at a wavelength in vacuum, µm; infinite of the perfect mirror.

        Raises:
            RequestError: outside of the table of the medium.
        """
        if self.index is None:
            return complex("inf")
        for known in self.known:
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


def index_files(parameters: Mapping[str, Any]) -> dict[str, Path]:
    """Return the files that a medium below is read from, by the parameters `material` and `int_ior`."""
    return {name: Path(str(parameters[name])) for name in _NAMES if is_file(parameters.get(name))}
