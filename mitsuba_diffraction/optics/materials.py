"""Refractive indices n + ik: numbers, names, and tables from files.

Conductors have the names of Mitsuba's `conductor` and of this package's `data/ior`; their tables are read without
loading Mitsuba. Transparent media have the names of `DISPERSION`, formulas n(λ) from the literature.
"""

from __future__ import annotations

import functools
import hashlib
import os
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib import metadata
from numbers import Complex
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from ..settings import VISIBLE

MIN_INDEX, MAX_INDEX = 0.01, 100.0
FILES = (".spd", ".csv", ".yml")
NOMINAL_WAVELENGTH = float(np.sqrt(VISIBLE[0] * VISIBLE[1])) * 1e-3
"""µm, in the middle of visible light. Where one number stands for a medium with dispersion, it is n at this λ."""
_OWN = Path(__file__).parents[1] / "data" / "ior"
_SYMBOLS = {
    **{"aluminium": "Al", "aluminum": "Al", "beryllium": "Be", "chrome": "Cr", "chromium": "Cr", "copper": "Cu"},
    **{"gold": "Au", "iridium": "Ir", "mercury": "Hg", "molybdenum": "Mo", "nickel": "Ni", "niobium": "Nb"},
    **{"rhodium": "Rh", "silver": "Ag", "tantalum": "Ta", "titanium": "Ti", "tungsten": "W", "vanadium": "V"},
}

# Name: formula, its coefficients (λ in µm), range in µm, source; for the formulas see `_formula`.
DISPERSION: dict[str, tuple[int, tuple[float, ...], tuple[float, float], str]] = {
    "BK7": (
        2,
        (0, 1.03961212, 0.00600069867, 0.231792344, 0.0200179144, 1.01046945, 103.560653),
        (0.3, 2.5),
        "Schott, data sheet of N-BK7",
    ),
    "fused_silica": (
        1,
        (0, 0.6961663, 0.0684043, 0.4079426, 0.1162414, 0.8974794, 9.896161),
        (0.21, 6.7),
        "Malitson 1965, J. Opt. Soc. Am. 55, 1205",
    ),
    "polycarbonate": (
        2,
        (0, 1.4182, 0.021304),
        (0.36, 1.052),
        "Sultanova, Kasarova and Nikolov 2009, Acta Phys. Pol. A 116, 585 (0.437 to 1.052 µm)",
    ),
    "PMMA": (
        2,
        (0, 1.1819, 0.011313),
        (0.36, 1.052),
        "Sultanova, Kasarova and Nikolov 2009, Acta Phys. Pol. A 116, 585 (0.437 to 1.052 µm)",
    ),
    "water": (
        2,
        (0, 0.568402757, 0.00510182971, 0.172617739, 0.0182115394, 0.0208618958, 0.0262072229, 0.113074869, 10.6979272),
        (0.182, 1.129),
        "Daimon and Masumura 2007, Appl. Opt. 46, 3811, at 20 °C",
    ),
    "keratin": (
        5,
        (1.532, 5.89e-3, -2),
        (0.36, 0.83),
        "Leertouwer, Wilts and Stavenga 2011, Opt. Express 19, 24061, feathers",
    ),
    "chitin": (
        5,
        (1.517, 8.80e-3, -2),
        (0.36, 0.83),
        "Leertouwer, Wilts and Stavenga 2011, Opt. Express 19, 24061, wing scales",
    ),
}


@dataclass(frozen=True, eq=False)
class RefractiveIndex:
    """n + ik over the wavelength in vacuum, linear between the wavelengths of a table.

    Attributes:
        name: as it was requested.
        wavelengths: µm, ascending, (J,); a single one of an index without dispersion.
        values: n + ik, (J,).
    """

    name: str
    wavelengths: NDArray[np.float64] = field(repr=False)
    values: NDArray[np.complex128] = field(repr=False)

    @property
    def _key(self) -> tuple[str, bytes, bytes]:
        return self.name, self.wavelengths.tobytes(), self.values.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RefractiveIndex) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __call__(self, wavelength: ArrayLike) -> NDArray[np.complex128]:
        """Return n + ik at wavelengths in µm, any shape; constant outside of the table."""
        n, k = (
            np.interp(np.asarray(wavelength), self.wavelengths, part) for part in (self.values.real, self.values.imag)
        )
        return n + 1j * k

    @property
    def digest(self) -> str:
        """SHA-256 of the table."""
        return hashlib.sha256(self.wavelengths.tobytes() + self.values.tobytes()).hexdigest()

    @property
    def nominal(self) -> complex:
        """n + ik in the middle of visible light."""
        return complex(self(NOMINAL_WAVELENGTH))

    @property
    def is_constant(self) -> bool:
        """Whether there is no dispersion."""
        return len(self.values) == 1

    @property
    def absorbs(self) -> bool:
        """Whether k > 0 at any wavelength."""
        return bool(self.values.imag.any())

    @property
    def range(self) -> tuple[float, float]:
        """(shortest, longest) wavelength at which the index is known, nm."""
        if self.is_constant:
            return 0.0, np.inf
        return float(self.wavelengths[0] * 1e3), float(self.wavelengths[-1] * 1e3)

    def __str__(self) -> str:
        return self.name


def constant(index: complex) -> RefractiveIndex:
    """Return an index without dispersion."""
    return RefractiveIndex(f"{index:g}", np.zeros(1), np.array([index], np.complex128))


def index_of(name: str, index: complex | str | os.PathLike[str]) -> RefractiveIndex:
    """Return the index of refraction of a parameter.

    Args:
        name: of the parameter, for messages.
        index: a number n or n + ik; the name of a medium of `DISPERSION`, or, except of `int_ior`, of a conductor; or a
            file (`read_index`).

    Raises:
        RequestError: if it is none of these.
        FileNotFoundError: if there is no such file.
    """
    if isinstance(index, str | os.PathLike):
        if is_file(index):
            return read_index(index)
        if (medium := _medium(str(index))) is not None:
            return medium
        if name == "int_ior":
            raise RequestError(f"int_ior: got {index!r}, wanted a number, a file or one of {', '.join(DISPERSION)}")
        return conductor(str(index))
    number = complex(index) if isinstance(index, Complex) and not isinstance(index, bool) else complex("nan")
    if not (MIN_INDEX <= abs(number) <= MAX_INDEX and number.real >= 0 and number.imag >= 0):
        raise RequestError(f"{name}: got {index!r}, wanted a refractive index, a number or n + ik with k ≥ 0")
    return constant(number)


def is_file(index: object) -> bool:
    """Return whether a text is the name of a file of an index."""
    return isinstance(index, str | os.PathLike) and Path(index).suffix.lower() in FILES


def is_dispersive(index: object) -> bool:
    """Return whether a text names a medium of `DISPERSION` or a file of an index."""
    return is_file(index) or (isinstance(index, str) and _medium(index) is not None)


def refractive_index(
    wavelength: float, *, int_ior: complex | str | None = None, material: str | None = None, known: bool = False
) -> complex:
    """Return n + ik of the medium below a surface.

    Args:
        wavelength: µm, in vacuum.
        int_ior: a number n or n + ik; or the name of a transparent medium, or a file (`index_of`).
        material: a conductor by Mitsuba's name ("Al", "Au", …), or "Ti"; or a file.
        known: whether to refuse infrared and ultraviolet wavelengths outside the table.

    Raises:
        ValueError: if not exactly one of `int_ior` and `material` is given, or it is unknown or out of range.
    """
    if (int_ior is None) == (material is None):
        raise RequestError(f"int_ior, material: got {int_ior!r}, {material!r}, wanted one of the two")
    name, value = ("int_ior", int_ior) if material is None else ("material", material)
    assert value is not None
    index = index_of(name, value)
    shortest, longest = index.range
    if name == "material" and not is_dispersive(value):
        # Conductors are constant in visible light where the table ends.
        shortest, longest = min(shortest, VISIBLE[0]), max(longest, VISIBLE[1])
    if known and not shortest * (1 - 1e-6) <= wavelength * 1e3 <= longest * (1 + 1e-6):
        raise RequestError(
            f"{name}: got {value!r} at {wavelength * 1e3:g} nm, wanted a wavelength from {shortest:.4g} to "
            f"{longest:.4g} nm, where its index is known; elsewhere give n + ik as int_ior"
        )
    return complex(index(wavelength))


def _spelling(name: str) -> str:
    return name.lower().replace(" ", "_").replace("-", "_")


@functools.cache
def _medium(name: str) -> RefractiveIndex | None:
    """Return a medium of `DISPERSION`, tabulated at steps of 1 nm, or None."""
    for known, (formula, coefficients, (first, last), _) in DISPERSION.items():
        if _spelling(name) == _spelling(known):
            wavelengths = np.arange(round(first * 1e3), round(last * 1e3) + 1, dtype=np.float64) * 1e-3
            return RefractiveIndex(
                known, wavelengths, _formula(formula, coefficients, wavelengths).astype(np.complex128)
            )
    return None


def _near(name: str, known: list[str]) -> list[str]:
    """Return the names in `known` that may be meant: of the same element or beginning, or spelt similarly."""
    lower = name.lower()
    if lower in _SYMBOLS:
        return [other for other in known if other.partition("_")[0] == _SYMBOLS[lower]]
    same = [other for other in known if other.lower().startswith(lower)]
    first = max((other for other in known if len(other) > 1 and lower.startswith(other.lower())), key=len, default=None)
    return [first] if first else same[:3] or get_close_matches(name, known)


@functools.cache
def conductor(material: str) -> RefractiveIndex:
    """Return the index of a conductor from the tables of Mitsuba and of this package.

    Raises:
        RequestError: if no material has this name.
    """
    folder = Path(str(metadata.distribution("mitsuba").locate_file("mitsuba/data/ior")))
    tables = [path for at in (_OWN, folder) for path in at.glob("*.eta.spd")]
    paths = {path.name.removesuffix(".eta.spd"): path for path in tables}
    known = sorted(paths)
    if material not in known:
        wanted = f"one of {', '.join(known) or 'none: no tables found'}"
        if near := _near(str(material), known):
            wanted = " or ".join(near)
        raise RequestError(f"material: got {material!r}, {'did you mean' if near else 'wanted'} {wanted}")
    found = read_index(paths[material])
    return RefractiveIndex(material, found.wavelengths, found.values)


def read_index(path: str | os.PathLike[str]) -> RefractiveIndex:
    """Read n + ik from a file.

    `.spd`: columns of the wavelength in nm and n, and k if there is a third one; beside `NAME.eta.spd`, `NAME.k.spd`
    has k, as in Mitsuba. `.csv` and `.yml`: as refractiveindex.info writes them, with wavelengths in µm. Supported
    formulas: 1 and 2 (Sellmeier), 3 (polynomial) and 5 (Cauchy).

    Raises:
        FileNotFoundError: if there is no such file.
        RequestError: if it is in another format, its wavelengths have another unit, or n or k are out of range.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    of_file = path.stat()
    return _read(path, of_file.st_mtime_ns, of_file.st_size)


@functools.lru_cache(maxsize=64)
def _read(path: Path, changed: int, size: int) -> RefractiveIndex:
    """Return the index in a file, read once for each state of it."""
    try:
        of_n, of_k = {".spd": _read_spd, ".csv": _read_csv, ".yml": _read_yml}[path.suffix.lower()](path)
    except RequestError as error:
        raise RequestError(f"{path}: {error}") from None
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RequestError(f"{path}: not a table of refractive indices ({text})") from None
    for table, what in ((of_n, "n"), (of_k, "k")):
        if table is None:
            continue
        if not (np.isfinite(table).all() and (np.diff(table[0]) > 0).all() and table[0, 0] > 0):
            raise RequestError(f"{path}: got wavelengths of {what} that do not ascend, or numbers that are not finite")
        low = MIN_INDEX if what == "n" else 0.0
        if table[1].min() < low or table[1].max() > MAX_INDEX:
            bad = table[1].min() if table[1].min() < low else table[1].max()
            raise RequestError(f"{path}: got {what} = {bad:g}, wanted {what} from {low:g} to {MAX_INDEX:g}")
    first, last = of_n[0, [0, -1]]
    # A visible table that was read in the other unit lies three powers of ten outside.
    unit, other = ("nm", "µm") if path.suffix.lower() == ".spd" else ("µm", "nm")
    if first > 50 or last < 0.02:
        scale = 1e3 if unit == "nm" else 1.0
        raise RequestError(
            f"{path}: got wavelengths from {first * scale:g} to {last * scale:g} {unit}: a table in {other}? "
            f"{path.suffix} files have {unit}"
        )
    if of_k is None:
        return RefractiveIndex(path.name, of_n[0], of_n[1] + 0j)
    if of_k[0, 0] > of_n[0, 0] * (1 + 1e-6) or of_k[0, -1] < of_n[0, -1] * (1 - 1e-6):
        raise RequestError(
            f"{path}: got n from {first * 1e3:g} to {last * 1e3:g} nm and k from {of_k[0, 0] * 1e3:g} to "
            f"{of_k[0, -1] * 1e3:g} nm, wanted k wherever n is known"
        )
    both = np.union1d(of_n[0], of_k[0])
    both = both[(both >= of_n[0, 0]) & (both <= of_n[0, -1])]
    return RefractiveIndex(path.name, both, np.interp(both, *of_n) + 1j * np.interp(both, *of_k))


_Table = NDArray[np.float64]
_Tables = tuple[_Table, _Table | None]
"""(2, J): wavelengths in µm, and n; the same of k, or None."""


def _columns(text: list[str], separator: str | None = None) -> _Table:
    """Return the columns of lines of numbers, (columns, lines)."""
    if not text:
        raise RequestError("got no numbers")
    return np.array([[float(x) for x in line.split(separator)] for line in text], np.float64).T


def _read_spd(path: Path) -> _Tables:
    def columns(of: Path) -> _Table:
        lines = (line.split("#")[0].strip() for line in of.read_text(encoding="utf-8", errors="replace").splitlines())
        table = _columns([line for line in lines if line])
        if len(table) < 2:
            raise RequestError("got one column, wanted wavelengths in nm and n")
        return table * np.array([1e-3, *[1.0] * (len(table) - 1)])[:, None]

    table = columns(path)
    of_k = path.with_name(path.name.removesuffix(".eta.spd") + ".k.spd")
    if path.name.endswith(".eta.spd") and of_k.is_file():
        return table[:2], columns(of_k)[:2]
    return table[:2], table[[0, 2]] if len(table) > 2 else None


def _read_csv(path: Path) -> _Tables:
    found: dict[str, list[list[str]]] = {}
    names: list[str] = []
    for line in path.read_text(encoding="utf-8-sig").splitlines():
        entries = [entry.strip() for entry in line.split(",")]
        if not any(entries):
            continue
        if entries[0].lower().startswith("wl"):
            names = [name.lower() for name in entries[1:]]
            found |= {name: [] for name in names}
        elif not names:
            raise RequestError(f"got {line[:40]!r}, wanted a header 'wl,n' or 'wl,n,k'")
        else:
            for name, value in zip(names, entries[1:], strict=True):
                found[name].append([entries[0], value])
    tables = {name: _columns([" ".join(row) for row in rows]) for name, rows in found.items()}
    if "n" not in tables:
        raise RequestError(f"got columns {', '.join(tables) or 'none'}, wanted n")
    return tables["n"], tables.get("k")


def _read_yml(path: Path) -> _Tables:
    import yaml

    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))["DATA"]
    except yaml.YAMLError as error:
        raise RequestError(f"not YAML ({str(error).splitlines()[0]})") from None
    of_n = of_k = None
    for entry in data:
        kind, _, which = entry["type"].partition(" ")
        if kind == "tabulated":
            table = _columns([line for line in entry["data"].splitlines() if line.strip()])
            of_n = table[:2] if which in ("nk", "n") else of_n
            of_k = table[[0, -1]] if which in ("nk", "k") else of_k
        else:
            first, last = (float(x) for x in str(entry.get("wavelength_range", entry.get("range"))).split())
            # As finely as the fastest dispersion that tables of visible light show.
            wavelengths = np.linspace(first, last, max(2, min(int((last - first) * 1e3) + 1, 20_000)))
            coefficients = tuple(float(x) for x in str(entry["coefficients"]).split())
            of_n = np.stack([wavelengths, _formula(int(which), coefficients, wavelengths)])
    if of_n is None:
        raise RequestError("got no n")
    return of_n, of_k


def _formula(number: int, coefficients: tuple[float, ...], wavelength: _Table) -> _Table:
    """Return n(λ) of the dispersion formulas 1, 2, 3 and 5 of refractiveindex.info, λ in µm.

    n² − 1 = C₁ + Σ C₂ᵢ λ²/(λ² − C₂ᵢ₊₁²) (1, Sellmeier; 2: C₂ᵢ₊₁ not squared), n² = C₁ + Σ C₂ᵢ λ^C₂ᵢ₊₁ (3),
    n = C₁ + Σ C₂ᵢ λ^C₂ᵢ₊₁ (5, Cauchy).
    """
    if number not in (1, 2, 3, 5):
        raise RequestError(f"got dispersion formula {number}, wanted 1, 2, 3 or 5, or a table")
    first, pairs = coefficients[0], list(zip(coefficients[1::2], coefficients[2::2], strict=True))
    if number in (3, 5):
        total = first + sum(c * wavelength**power for c, power in pairs)
        result = np.sqrt(total) if number == 3 else total
    else:
        square = wavelength**2
        result = np.sqrt(1 + first + sum(c * square / (square - (x**2 if number == 1 else x)) for c, x in pairs))
    return np.asarray(result, np.float64)
