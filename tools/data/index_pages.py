"""Count the pages of refractiveindex.info that are read, of those that know n over visible light.

    git clone https://github.com/polyanskiy/refractiveindex.info-database
    python tools/data/index_pages.py refractiveindex.info-database/database/data

Lists the refused ones with the reason. docs/materials.md has the counts. The values of all formulas are tested in
tests/optics/test_indices.py.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import yaml

from mitsuba_diffraction.optics.refractive_indices import read_index

BAND = 0.4, 0.7  # µm


def range_of_n(path: Path) -> tuple[float, float] | None:
    """Return the wavelengths, µm, at which a page knows n; None if it has none, such as a page of n₂."""
    found = None
    for entry in yaml.safe_load(path.read_text(encoding="utf-8")).get("DATA") or []:
        kind, _, which = str(entry.get("type")).partition(" ")
        if kind == "formula" and which.isdecimal():
            first, last = map(float, entry["wavelength_range"].split())
            found = first, last
        elif kind == "tabulated" and which in ("n", "nk"):
            wavelengths = [float(line.split()[0]) for line in entry["data"].splitlines() if line.strip()]
            found = min(wavelengths), max(wavelengths)
    return found


def main() -> None:
    """Print the counts, and the refused pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the folder of the pages")
    folder, pages, refused = parser.parse_args().folder, 0, 0
    for path in sorted(folder.rglob("*.yml")):
        known = range_of_n(path)
        if known is None or known[0] > BAND[0] or known[1] < BAND[1]:
            continue
        pages += 1
        try:
            read_index(path)
        except ValueError as error:
            refused += 1
            print(f"{path.relative_to(folder)}: {str(error).partition(': ')[2]}")
    print(f"{pages} pages know n from {BAND[0]} to {BAND[1]} µm, {pages - refused} of them are read")


if __name__ == "__main__":
    main()
