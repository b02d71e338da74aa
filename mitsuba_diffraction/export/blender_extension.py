"""The extension of Blender (.zip): the code in assets/blender, and the tables of the surfaces in its list."""

from __future__ import annotations

import io
import os
import tempfile
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ..files.outputs import MARK
from ..files.writing import examples_folder, whole_file
from ..optics.media import MediumBelow
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.requested_surface import RequestedSurface
from ..progress import Progress, silent
from .cycles import write_shader
from .node_tables import write_node_tables
from .shader_tables import ShaderTables, bins_of_wavelengths, shader_recipe

_CODE = Path(__file__).parent / "assets" / "blender"
_OF_METALS = "material=Al"
_SURFACES = {
    "compact_disc": _OF_METALS,
    "dvd": _OF_METALS,
    "foil": _OF_METALS,
    "xenopeltis": "",
    "elaphe": "",
    "film": "",
}
_METALS = ("Al", "Ag", "Au", "Cu")


def write_extension(path: str | os.PathLike[str], progress: Progress = silent) -> str:
    """Write the extension; return what it holds.

    Args:
        path: of the file.
        progress: called with (surfaces done, surfaces in all).
    """
    root = examples_folder()
    with whole_file(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.comment = MARK.encode()
        for file in sorted(_CODE.glob("*.*")):
            archive.writestr(
                file.name, file.read_text(encoding="utf-8").replace("{{version}}", version("mitsuba_diffraction"))
            )
        archive.write(root / "LICENSE", "LICENSE")
        archive.write(root / "precompute" / "measured" / "LICENSE.txt", "tables/LICENSE-of-skins.txt")
        archive.writestr("tables/metals.npz", _indices())
        with tempfile.TemporaryDirectory() as folder:
            for done, (name, aside) in enumerate(_SURFACES.items(), 1):
                requested = RequestedSurface.of(",".join(filter(None, [name, aside])), aside=("material",))
                spectrum = shader_recipe(requested.recipe).cached()
                assert isinstance(spectrum, GratingSpectrum)
                tables = ShaderTables.of_spectrum(spectrum, requested.below, requested.is_film)
                for write, suffix in ((write_node_tables, ".npz"), (write_shader, ".osl")):
                    if tables.sheet and suffix == ".osl":  # which does not show what it transmits
                        continue
                    file = Path(folder, name + suffix)
                    write(tables, file)
                    archive.write(file, f"tables/{file.name}")
                progress(done, len(_SURFACES))
    return f"extension of Blender 4.2 or later, {len(_SURFACES)} surfaces"


def _indices() -> bytes:
    """Return a file of the indices of metals in the middle of each bin."""
    edges, _ = bins_of_wavelengths()
    stream = io.BytesIO()
    media = {name: MediumBelow.of(name) for name in _METALS}
    middle = (edges[1:] + edges[:-1]) / 2
    indices: dict[str, Any] = {name: np.array([medium.index_at(w) for w in middle]) for name, medium in media.items()}
    np.savez_compressed(stream, **indices)
    return stream.getvalue()
