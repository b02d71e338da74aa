"""Render the gallery at low resolution and fail if a picture differs from its reference by more than noise.

    python scenes/gallery.py                 # every picture
    python scenes/gallery.py foil_sun        # some
    python scenes/gallery.py --write         # new references, after an intended change
    python scenes/gallery.py --compress      # previews in docs/gallery become JPEG files of less than 500 kB

The commands are taken from docs/gallery.md: first the scripts that generate the models, if they are missing, then each
`mitsuba-diffraction render … -o docs/gallery/NAME.exr`, at 160 × 90 pixels and 8 samples per pixel.

Linear sRGB c is mapped to c/(c + m), where m is the mean of the reference, to limit the weight of fireflies, and
averaged over squares of 10 and of 30 pixels and over the picture. The reference holds the mean and the standard
deviation s of each average over n renderings with independent seeds. An average of a new picture that deviates by Δ has
t = Δ/(s √(1 + 1/n)), with s at least its root mean square over all squares of that size. A picture has changed if the
probability of its maximum |t| is below 0.001 (Student's t with n − 1 degrees of freedom, Šidák's correction (1967)
for the number of averages).
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import stats

from mitsuba_diffraction.cli import app
from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.optics.color import into_gamut, radiance_to_linear_sRGB
from mitsuba_diffraction.render import SpectralImage

ROOT = Path(__file__).parents[1]
REFERENCES = Path(__file__).with_name("gallery.npz")
SIZE, SAMPLES, SQUARES = (160, 90), 8, (10, 30)
SEEDS = 12  # of the references
SIGNIFICANCE = 1e-3
MAX_FILE_SIZE, QUALITIES = 500_000, (95, 92, 90, 87, 85, 80, 77)  # bytes; of JPEG

Array = NDArray[np.float64]


def commands(pages: Sequence[Path]) -> tuple[list[list[str]], dict[str, list[str]]]:
    """Return the commands on the pages: those that generate models, and by picture those that render it.

    Raises:
        ValueError: if two commands disagree about one picture.
    """
    models: list[list[str]] = []
    renderings: dict[str, list[str]] = {}
    for page in pages:
        text = page.read_text(encoding="utf-8")
        for script in re.findall(r"python (scenes/\w+\.py)(?=\s|`)", text):
            words = [sys.executable, script]
            if words not in models and Path(script).stem != Path(__file__).stem:
                models.append(words)
        for line in re.findall(r"mitsuba-diffraction (render scenes/[^`|\n]*? -o docs/gallery/\w+\.exr)", text):
            words = shlex.split(line)
            name = Path(words[words.index("-o") + 1]).stem
            if renderings.setdefault(name, words) != words:
                raise ValueError(f"{page.name}: got another command for {name}, wanted one for each picture")
    return models, renderings


def small(words: Sequence[str], seed: int, target: Path) -> list[str]:
    """Return the same command at low resolution, with a given seed, writing to `target`."""
    words = [words[0], str(ROOT / words[1]), *words[2:]]
    for option in ("-o", "--spp", "--width", "--height", "--seed"):
        if option in words:
            index = words.index(option)
            del words[index : index + 2]
    words = [word for word in words if word != "--denoise"] + ["--no-denoise"]
    size = ["--width", str(SIZE[0]), "--height", str(SIZE[1]), "--spp", str(SAMPLES)]
    return [*words, *size, "--seed", str(seed), "-o", str(target)]


def rendered(words: Sequence[str], seed: int) -> Array:
    """Return the linear sRGB of a command's picture at low resolution, (height, width, 3).

    Raises:
        ValueError: if the command does, for example for a wrong scene.
    """
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "picture.exr"
        # In this process, so that Dr.Jit's kernel cache is shared by all pictures.
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            app(small(words, seed, target), standalone_mode=False, obj={})
        image = SpectralImage.load(target)
    return into_gamut(radiance_to_linear_sRGB(image.radiance, image.wavelengths))


@dataclass(frozen=True)
class Reference:
    """Statistics of the pictures of one command.

    Attributes:
        level: m, the mean of the pictures.
        mean, deviation: of the averages, (k,).
        count: n, the number of pictures.
    """

    level: float
    mean: Array
    deviation: Array
    count: int

    @classmethod
    def of(cls, pictures: Sequence[Array]) -> Reference:
        """Return the reference from pictures with different seeds."""
        level = float(np.mean(pictures))
        values = np.array([averages(picture, level) for picture in pictures])
        return cls(level, values.mean(0), values.std(0, ddof=1), len(pictures))

    def probability(self, picture: Array) -> float:
        """Return the probability that noise alone makes a picture differ as much."""
        # A few pictures may miss the rare bright paths of a square: s is at least its root mean square.
        scale = scales(picture.shape)
        rms = np.sqrt(np.bincount(scale, self.deviation**2) / np.bincount(scale))[scale]
        # Where there is hardly any noise, differences of 1/2000 are invisible.
        deviation = np.maximum(np.maximum(self.deviation, rms), 1 / 2000) * np.sqrt(1 + 1 / self.count)
        t = (averages(picture, self.level) - self.mean) / deviation
        p_value = 2 * stats.t.sf(np.abs(t).max(), self.count - 1)
        return float(-np.expm1(t.size * np.log1p(-p_value)))


def averages(picture: Array, level: float) -> Array:
    """Return the means of c/(c + m) over squares and over the picture, (k,)."""
    mapped = picture / (picture + level)
    parts = [mapped.mean((0, 1))]
    for side in SQUARES:
        rows, columns = (n // side for n in picture.shape[:2])
        whole = mapped[: rows * side, : columns * side].reshape(rows, side, columns, side, 3)
        parts.append(whole.mean((1, 3)).ravel())
    return np.concatenate(parts)


def scales(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the index of the size of each average, (k,): 0 for the picture, from 1 on for `SQUARES`."""
    counts = [1, *((shape[0] // side) * (shape[1] // side) for side in SQUARES)]
    return np.repeat(np.arange(len(counts)), 3 * np.array(counts))


def load(path: Path) -> dict[str, Reference]:
    """Return the references in a file, by picture."""
    with np.load(path) as file:
        names = sorted({key.split(".")[0] for key in file})
        return {
            name: Reference(
                float(file[f"{name}.level"]),
                file[f"{name}.mean"],
                file[f"{name}.deviation"],
                int(file[f"{name}.count"]),
            )
            for name in names
        }


def save(references: Mapping[str, Reference], path: Path) -> None:
    """Write references, in single precision."""
    arrays = {}
    for name, reference in sorted(references.items()):
        arrays[f"{name}.level"], arrays[f"{name}.count"] = np.float64(reference.level), np.int64(reference.count)
        arrays[f"{name}.mean"] = reference.mean.astype(np.float32)
        arrays[f"{name}.deviation"] = reference.deviation.astype(np.float32)
    with whole_file(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def compress(path: Path) -> tuple[Path, int]:
    """Replace a preview (.png) by a JPEG file in true colour; return its name and quality.

    The quality is the highest of `QUALITIES` for which the file is smaller than 500 kB. Chroma has the full resolution,
    as spectra have fine lines of different colour and equal luminance.

    Raises:
        ValueError: if the file has a palette, whose dots would be kept, or is too large at the lowest quality.
    """
    with Image.open(path) as picture:
        if picture.mode != "RGB":
            raise ValueError(f"{path.name}: got mode {picture.mode}, wanted true colour: render it anew")
        for quality in QUALITIES:
            stream = io.BytesIO()
            picture.save(stream, "JPEG", quality=quality, subsampling="4:4:4")
            if stream.tell() < MAX_FILE_SIZE:
                break
        else:
            raise ValueError(f"{path.name}: got {stream.tell() // 1000} kB at quality {quality}, wanted less noise")
    target = path.with_suffix(".jpg")
    with whole_file(target) as temporary:
        temporary.write_bytes(stream.getvalue())
    path.unlink()
    return target, quality


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the check; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="pictures; all by default")
    parser.add_argument("--write", action="store_true", help="make new references")
    parser.add_argument("--compress", action="store_true", help="compress the pictures in docs/gallery")
    options = parser.parse_args(arguments)
    if options.compress:
        for path in sorted((ROOT / "docs" / "gallery").glob("*.png")):
            try:
                target, quality = compress(path)
                print(f"{target.name}: {target.stat().st_size // 1000} kB, quality {quality}")
            except ValueError as error:
                print(error)
        return 0
    models, renderings = commands([ROOT / "docs" / "gallery.md"])
    if unknown := set(options.names) - set(renderings):
        parser.error(f"got {', '.join(sorted(unknown))}, wanted names among {', '.join(renderings)}")
    if not (ROOT / "scenes" / "models").is_dir():
        for words in models:
            subprocess.run(words, cwd=ROOT, check=True)
    references = load(REFERENCES) if REFERENCES.is_file() else {}
    changed = 0
    for name in options.names or renderings:
        words = renderings[name]
        if options.write:
            references[name] = Reference.of([rendered(words, 100 + seed) for seed in range(SEEDS)])
            save(references, REFERENCES)
            print(f"{name}: reference of {SEEDS} pictures", flush=True)
        elif name not in references:
            changed += 1
            print(f"{name}: no reference; --write makes one", flush=True)
        else:
            probability = references[name].probability(rendered(words, 0))
            same = probability >= SIGNIFICANCE
            changed += not same
            print(f"{name}: {'unchanged' if same else 'CHANGED'}, p = {probability:.2g}", flush=True)
    return int(changed > 0)


if __name__ == "__main__":
    sys.exit(main())
