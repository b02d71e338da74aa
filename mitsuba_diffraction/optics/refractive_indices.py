"""Refractive indices n + ik: numbers, names, and tables from files.

Conductors have the names of Mitsuba's `conductor` and of this package's `data/ior`; their tables are read without
loading Mitsuba. Transparent media have the names of `DISPERSION`, formulas n(λ) from the literature.
"""

from __future__ import annotations

import functools
import hashlib
import os
import warnings
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib import metadata
from numbers import Complex
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from ..files.reading import check_file
from ..settings import VISIBLE

MIN_INDEX, MAX_INDEX = 0.01, 100.0
MAX_CLEAR_K = 1e-4  # of a transparent medium; glass of 0.1 mm with this k absorbs a fifth of green light
_STRICT = 0.3, 1.1  # µm: what cannot be is refused there; elsewhere the range ends at it, as at the pole of a formula
_MAX_FAR = 1e5  # of n and k elsewhere: metals have a thousand in the far infrared
_MAX_NOISE = 5e-3  # of k, by which measured curves fall below 0
_MAX_SPREAD = 0.05  # of n or k, relative, in rows of one wavelength
_ROWS = 20_000  # at most, of a formula
_MIN_LIKENESS = 0.8  # of a wrong name to one that is proposed, from 0 to 1
MAX_INDEX_BYTES = 2**19  # of a file of an index; pages have 2 to 300 kB
_MAX_LEVEL = 8  # of nested lists and mappings; pages have four
FILES = (".spd", ".csv", ".yml")
_PAGE = "a file, such as a page of refractiveindex.info (.yml)"
_FAR_INFRARED = 5e4  # nm, where tables begin that have, or seem to have, wavelengths of another unit
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


@dataclass(frozen=True)
class Doubt:
    """What is in doubt about an index, from `wavelengths[0]` to `wavelengths[1]`, nm."""

    wavelengths: tuple[float, float]
    text: str


@dataclass(frozen=True)
class KnownRange:
    """The wavelengths at which the index of a parameter is known.

    Attributes:
        parameter: that names the index.
        source: the name of the medium or of the file.
        wavelengths: (shortest, longest), nm.
        clear: the index, of a medium that is taken as transparent; else None.
        doubts: about the index.
    """

    parameter: str
    source: str
    wavelengths: tuple[float, float]
    clear: RefractiveIndex | None = None
    doubts: tuple[Doubt, ...] = ()

    def check(self, light: tuple[float, float]) -> None:
        """Check that the index is known for light of wavelengths (shortest, longest), nm.

        Raises:
            RequestError: if it is not, or the light is absorbed where the medium is taken as transparent.

        Warns:
            UserWarning: if the index is in doubt for this light.
        """
        (first, last), (shortest, longest) = light, self.wavelengths
        of_light = _nanometres(light)
        unit = "; wavelengths of .csv and .yml are in µm" if shortest > _FAR_INFRARED else ""
        if first < shortest * (1 - 1e-6) or last > longest * (1 + 1e-6):
            raise RequestError(
                f"{self.parameter}: got light of {of_light}, and a table of {_nanometres(self.wavelengths)} "
                f"({self.source}); wanted light inside its range, or another index, from {_PAGE}{unit}"
            )
        if self.clear is not None and (k := self.clear.max_k(light)) > MAX_CLEAR_K:
            raise RequestError(
                f"{self.parameter}: got light of {of_light}, and k up to {k:.3g} ({self.source}), wanted a transparent "
                "medium; give it as material"
            )
        for doubt in self.doubts:
            if doubt.wavelengths[0] < last and doubt.wavelengths[1] > first:
                warnings.warn(f"{self.parameter}: {self.source} has {doubt.text}", stacklevel=2)


def _nanometres(wavelengths: tuple[float, float]) -> str:
    first, last = wavelengths
    return f"{first:.6g} nm" if first == last else f"{first:.6g} to {last:.6g} nm"


@dataclass(frozen=True, eq=False)
class RefractiveIndex:
    """n + ik over the wavelength in vacuum, linear between the wavelengths of a table.

    Attributes:
        name: as it was requested.
        wavelengths: µm, ascending, (J,); a single 0 of an index without dispersion.
        values: n + ik, (J,).
        doubts: where they are not those of a file.
    """

    name: str
    wavelengths: NDArray[np.float64] = field(repr=False)
    values: NDArray[np.complex128] = field(repr=False)
    doubts: tuple[Doubt, ...] = field(default=(), repr=False)

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
        return not self.wavelengths[0]

    def max_k(self, light: tuple[float, float]) -> float:
        """Return the maximum of k at wavelengths (shortest, longest), nm."""
        first, last = (1e-3 * wavelength for wavelength in light)
        inside = self.wavelengths[(self.wavelengths > first) & (self.wavelengths < last)]
        return float(self([first, *inside, last]).imag.max())

    @property
    def absorbs(self) -> bool:
        """Whether k is above that of clear glass in visible light."""
        return self.max_k(VISIBLE) > MAX_CLEAR_K

    @property
    def range(self) -> tuple[float, float]:
        """(shortest, longest) wavelength at which the index is known, nm."""
        if self.is_constant:
            return 0.0, np.inf
        return float(self.wavelengths[0] * 1e3), float(self.wavelengths[-1] * 1e3)

    def known_range(self, parameter: str, clear: bool = False) -> KnownRange:
        """Return where the index is known, for a parameter that names it; `clear`: taken as transparent there."""
        return KnownRange(parameter, self.name, self.range, self if clear else None, self.doubts)

    def __str__(self) -> str:
        return self.name


def constant(index: complex) -> RefractiveIndex:
    """Return an index without dispersion."""
    name = f"{index.real:g}" if index.imag == 0 else f"{index:g}"
    return RefractiveIndex(name, np.zeros(1), np.array([index], np.complex128))


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
            try:
                return read_index(index)
            except RequestError as error:
                raise RequestError(f"{name}: {error}") from None
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
    if known:
        index.known_range(name).check((wavelength * 1e3, wavelength * 1e3))
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
    """Return the names in `known` that are meant: of the same element or compound, or of a word spelt similarly."""
    lower = name.lower()
    symbol = _stem(name)
    if symbol not in map(_stem, known):
        words = [word for word in _SYMBOLS if len(lower) > 2 and word.startswith(lower)]
        words = words or get_close_matches(lower, _SYMBOLS, n=1, cutoff=_MIN_LIKENESS)
        symbol = _SYMBOLS[words[0]].lower() if words else ""
    same = [other for other in known if _stem(other) == symbol]
    return same or get_close_matches(name, [other for other in known if len(other) > 4], n=1, cutoff=_MIN_LIKENESS)


def _stem(name: str) -> str:
    """Return the element or compound in the name of a conductor, as in Al_palik, in lower case."""
    return name.lower().partition("_")[0]


@functools.cache
def conductor(material: str) -> RefractiveIndex:
    """Return the index of a conductor from the tables of Mitsuba and of this package.

    It is constant in visible light where its table ends.

    Raises:
        RequestError: if no material has this name.
    """
    folder = Path(str(metadata.distribution("mitsuba").locate_file("mitsuba/data/ior")))
    tables = [path for at in (_OWN, folder) for path in at.glob("*.eta.spd")]
    paths = {path.name.removesuffix(".eta.spd"): path for path in tables}
    known = sorted(paths)
    if material not in known:
        wanted = f"one of {', '.join(known) or 'none: no tables found'}, or {_PAGE}"
        if near := _near(str(material), known):
            wanted = " or ".join(near)
        raise RequestError(f"material: got {material!r}, {'did you mean' if near else 'wanted'} {wanted}")
    found = read_index(paths[material])
    first, last = min(found.wavelengths[0], VISIBLE[0] * 1e-3), max(found.wavelengths[-1], VISIBLE[1] * 1e-3)
    wavelengths = np.unique([first, *found.wavelengths, last])
    return RefractiveIndex(material, wavelengths, found(wavelengths))


def read_index(path: str | os.PathLike[str]) -> RefractiveIndex:
    """Read n + ik from a file; it is known where both n and k are.

    `.spd`: columns of the wavelength in nm and n, and k if there is a third one; beside `NAME.eta.spd`, `NAME.k.spd`
    has k, as in Mitsuba. `.csv` and `.yml`: as refractiveindex.info writes them, with wavelengths in µm: tables, and
    its dispersion formulas.

    Raises:
        FileNotFoundError: if there is no such file.
        RequestError: if it is in another format, its wavelengths have another unit, or n or k are out of range.
    """
    path = Path(path)
    of_k = _path_of_k(path)
    for file in (path, of_k):
        if file is not None:
            check_file(file, MAX_INDEX_BYTES)
    return _read(
        path, *(stat for file in (path, of_k) if file for stat in (file.stat().st_mtime_ns, file.stat().st_size))
    )


def _path_of_k(path: Path) -> Path | None:
    """Return the file of k beside a file of n, `NAME.eta.spd`, if there is one."""
    of_k = path.with_name(path.name.removesuffix(".eta.spd") + ".k.spd")
    return of_k if path.name.endswith(".eta.spd") and of_k.is_file() else None


@functools.lru_cache(maxsize=64)
def _read(path: Path, *state: int) -> RefractiveIndex:
    """Return the index in a file, read once for each state of it and of the file of k beside it."""
    try:
        of_n, of_k = {".spd": _read_spd, ".csv": _read_csv, ".yml": _read_yml}[path.suffix.lower()](path)
        of_n, of_k = _ascending(of_n, "n"), None if of_k is None else _ascending(of_k, "k")
        if path.suffix.lower() == ".spd" and of_n[0, -1] < 0.02:
            first, last = of_n[0, [0, -1]] * 1e3
            raise RequestError(f"got wavelengths from {first:g} to {last:g} nm: a table in µm? .spd files have nm")
        wavelengths, n, k = _where_known(of_n, of_k)
        start, stop = _possible_rows(wavelengths, n, k)
    except RequestError as error:
        raise RequestError(f"{path}: {error}") from None
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, ArithmeticError) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RequestError(f"{path}: not a table of refractive indices ({text})") from None
    known = wavelengths[start:stop]
    index = n[start:stop] + 1j * np.maximum(k[start:stop], 0)
    return RefractiveIndex(path.name, known, index, _doubts(known, of_k))


def _ascending(table: _Table, what: str) -> _Table:
    """Return the rows of a table by their wavelength; those of one wavelength are one, their mean.

    Raises:
        RequestError: if rows of one wavelength differ, or there are several tables in one.
    """
    if not (np.isfinite(table[0]).all() and table[0].min() > 0):
        raise RequestError(f"got wavelengths of {what} that are not positive numbers")
    if table[0, 0] > table[0, -1]:
        table = table[:, ::-1]
    order = np.argsort(table[0], kind="stable")
    if 2 * np.count_nonzero(order != np.arange(len(order))) > len(order):
        raise RequestError(f"got wavelengths of {what} that neither ascend nor descend, wanted one table")
    wavelengths, row, count = np.unique(table[0], return_inverse=True, return_counts=True)
    value = np.bincount(row, table[1]) / count
    differs = np.abs(table[1] - value[row]) > _MAX_SPREAD * np.abs(value[row]) + 1e-3
    if differs.any():
        at = table[0, differs][0]
        both = " and ".join(f"{v:g}" for v in table[1, table[0] == at])
        raise RequestError(f"got {what} = {both} at {at * 1e3:g} nm, wanted one value for each wavelength")
    return np.stack([wavelengths, value])


def _where_known(of_n: _Table, of_k: _Table | None) -> tuple[_Table, _Table, _Table]:
    """Return the wavelengths at which n is known, and k is or may be taken as 0, with n and k.

    k is 0 without a table of it, and beyond an end of its table at which it is that of clear glass.

    Raises:
        RequestError: if there are none.
    """
    if of_k is None:
        return of_n[0], of_n[1], np.zeros_like(of_n[1])
    clear = of_k[1, [0, -1]] <= MAX_CLEAR_K
    first = of_n[0, 0] if clear[0] else max(of_n[0, 0], of_k[0, 0])
    last = of_n[0, -1] if clear[1] else min(of_n[0, -1], of_k[0, -1])
    if first > last:
        ranges = (f"{table[0, 0] * 1e3:g} to {table[0, -1] * 1e3:g} nm" for table in (of_n, of_k))
        raise RequestError("got n from {} and k from {}, wanted both at the same wavelengths".format(*ranges))
    both = np.union1d(of_n[0], of_k[0])
    both = both[(both >= first) & (both <= last)]
    return both, np.interp(both, *of_n), np.interp(both, of_k[0], of_k[1], left=0.0, right=0.0)


def _doubts(wavelengths: _Table, of_k: _Table | None) -> tuple[Doubt, ...]:
    """Return where the k of a table of these wavelengths is not that of the file; `of_k` has the rows of the file."""
    if of_k is None:
        return ()
    (first, last), (start, stop) = 1e3 * wavelengths[[0, -1]], 1e3 * of_k[0, [0, -1]]
    ends = [(first, min(start, last)), (max(stop, first), last)]
    found = [Doubt(end, f"no k from {_nanometres(end)}, taken as 0") for end in ends if end[0] < end[1]]
    negative = of_k[0, of_k[1] < 0] * 1e3
    if negative.size:
        found.append(Doubt((negative[0], negative[-1]), f"k down to {of_k[1].min():.2g}, taken as 0"))
    return tuple(found)


def max_index(wavelengths: ArrayLike) -> NDArray[np.float64]:
    """Return the largest possible n or k at wavelengths in µm, any shape: in the far infrared metals have more."""
    micrometres = np.asarray(wavelengths)
    return np.where((micrometres >= _STRICT[0]) & (micrometres <= _STRICT[1]), MAX_INDEX, _MAX_FAR)


def _possible_rows(wavelengths: _Table, n: _Table, k: _Table) -> tuple[int, int]:
    """Return (first, end) of the rows whose n and k can be; those in `_STRICT` all are.

    Raises:
        RequestError: if one of these cannot be, or, without one there, any row.
    """
    strict = (wavelengths >= _STRICT[0]) & (wavelengths <= _STRICT[1])
    limit = max_index(wavelengths)
    strict |= not strict.any()
    of_both = [("n", n, (n >= MIN_INDEX) & (n <= limit)), ("k", k, (k >= -_MAX_NOISE) & (k <= limit))]
    for what, values, can_be in of_both:
        if (bad := np.flatnonzero(strict & ~can_be)).size:
            low = MIN_INDEX if what == "n" else 0.0
            raise RequestError(f"got {what} = {values[bad[0]]:g}, wanted {what} from {low:g} to {limit[bad[0]]:g}")
    wrong, rows = np.flatnonzero(~(of_both[0][2] & of_both[1][2])), np.flatnonzero(strict)
    before, after = wrong[wrong < rows[0]], wrong[wrong > rows[-1]]
    return int(before[-1]) + 1 if before.size else 0, int(after[0]) if after.size else len(n)


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

    table, of_k = columns(path), _path_of_k(path)
    if of_k is not None:
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
        data = yaml.load(path.read_text(encoding="utf-8"), _flat_loader())["DATA"]
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
            if not 0 < first <= last < np.inf:
                raise RequestError(f"got a formula from {first:g} to {last:g} µm, wanted the range of wavelengths")
            # As finely as the fastest dispersion that tables of visible light show.
            count = max(2, int((last - first) * 1e3) + 1)
            wavelengths = np.linspace(first, last, count) if count <= _ROWS else np.geomspace(first, last, _ROWS)
            coefficients = tuple(float(x) for x in str(entry["coefficients"]).split())
            of_n = np.stack([wavelengths, _formula(int(which), coefficients, wavelengths)])
    if of_n is None:
        raise RequestError("got no n")
    return of_n, of_k


@functools.cache
def _flat_loader() -> Any:
    """Return a loader of YAML for texts, lists and mappings of few levels."""
    import yaml

    class _FlatLoader(yaml.BaseLoader):
        """Refuses aliases, by which a short text stands for a long one, and deep levels."""

        level = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise RequestError("got an alias of YAML (*), wanted values")
            if self.level >= _MAX_LEVEL:
                raise RequestError(f"got YAML of more than {_MAX_LEVEL} levels")
            self.level += 1
            node = super().compose_node(parent, index)
            self.level -= 1
            return node

    return _FlatLoader


def _formula(number: int, coefficients: tuple[float, ...], wavelength: _Table) -> _Table:
    """Return n(λ) of the dispersion formulas of refractiveindex.info, λ in µm; missing coefficients are 0.

    n² − 1 = C₁ + Σ C₂ᵢ λ²/(λ² − C₂ᵢ₊₁²) (1, Sellmeier; 2: C₂ᵢ₊₁ not squared), n² = C₁ + Σ C₂ᵢ λ^C₂ᵢ₊₁ (3),
    n² = C₁ + C₂ λ^C₃/(λ² − C₄^C₅) + C₆ λ^C₇/(λ² − C₈^C₉) + Σ C₁₀ λ^C₁₁ (4), n = C₁ + Σ C₂ᵢ λ^C₂ᵢ₊₁ (5, Cauchy),
    n − 1 = C₁ + Σ C₂ᵢ/(C₂ᵢ₊₁ − λ⁻²) (6, gases), n = C₁ + C₂ L + C₃ L² + C₄ λ² + C₅ λ⁴ + C₆ λ⁶ with
    L = 1/(λ² − 0.028) (7, Herzberger), (n² − 1)/(n² + 2) = C₁ + C₂ λ²/(λ² − C₃) + C₄ λ² (8),
    n² = C₁ + C₂/(λ² − C₃) + C₄ (λ − C₅)/((λ − C₅)² + C₆) (9).
    """
    if not 1 <= number <= 9:
        raise RequestError(f"got dispersion formula {number}, wanted 1 to 9, or a table")
    c = [*coefficients, *[0.0] * (9 - len(coefficients)), *[0.0] * (len(coefficients) % 2 == 0)]
    first, pairs, square = c[0], list(zip(c[1::2], c[2::2], strict=False)), wavelength**2
    with np.errstate(invalid="ignore", divide="ignore"):  # outside of its range of validity
        if number in (1, 2):
            found = 1 + first + sum(a * square / (square - (b**2 if number == 1 else b)) for a, b in pairs)
        elif number == 4:
            # Without the terms that are left out: theirs would be 0/0 at 1 µm.
            poles = (c[k] * wavelength ** c[k + 1] / (square - c[k + 2] ** c[k + 3]) for k in (1, 5) if c[k])
            found = first + sum(poles) + sum(a * wavelength**b for a, b in pairs[4:])
        elif number == 6:
            found = 1 + first + sum(a / (b - 1 / square) for a, b in pairs)
        elif number == 7:
            pole = 1 / (square - 0.028)
            found = first + c[1] * pole + c[2] * pole**2 + c[3] * square + c[4] * square**2 + c[5] * square**3
        elif number == 8:
            ratio = first + c[1] * square / (square - c[2]) + c[3] * square
            found = (1 + 2 * ratio) / (1 - ratio)
        elif number == 9:
            step = wavelength - c[4]
            found = first + c[1] / (square - c[2]) + c[3] * step / (step**2 + c[5])
        else:
            found = first + sum(a * wavelength**b for a, b in pairs)
        return np.asarray(np.sqrt(found) if number in (1, 2, 3, 4, 8, 9) else found, np.float64)
