"""Configurations of a grating, drawn at random and continuously from everything that a scene may request."""

from __future__ import annotations

import functools
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
from hypothesis import strategies as st
from soak_model import Cauchy, index_of

import mitsuba_diffraction as md

METALS = ("Al", "Au", "Ag", "Cu", "Cr")
VISIBLE = (360.0, 830.0)


@dataclass(frozen=True)
class Surface:
    """A relief of one period, or a piece of a random one.

    `shape` is the apex of a triangle (1: a sawtooth) or the width of a ridge, as fractions of the period; random
    surfaces are drawn from `seed`. A crossed one is the sum of both profiles, along x and y.
    """

    kind: str = "sinusoid"
    period: tuple[float, float] = (2.5, 2.5)
    depth: float = 0.3
    shape: float = 1.0
    seed: int = 0
    turned: bool = False
    count: int = 1
    by_name: bool = False

    @property
    def is_line(self):
        return self.kind in ("flat", "sinusoid", "triangle", "ridges", "harmonics")

    @property
    def samples(self):
        # Frequencies of all light that propagates inside of the densest medium, at lengths scaled by one.
        return 512 if self.is_line else 96

    @property
    def tile(self):
        n = self.samples
        if self.is_line:
            return (self.period[0] / n, self.period[0]) if self.turned else (self.period[0], self.period[0] / n)
        return self.period

    def _profile(self, kind, seed):
        x = np.arange(self.samples) / self.samples
        if kind == "flat":
            return 0 * x
        if kind == "sinusoid":
            return self.depth * 0.5 * (1 + np.sin(2 * np.pi * x))
        if kind == "triangle":
            rise = x / self.shape
            return self.depth * np.where(x < self.shape, rise, (1 - x) / max(1 - self.shape, 1e-9))
        if kind == "ridges":
            return self.depth * (x < self.shape)
        rng = np.random.default_rng(seed)
        k = np.arange(1, 7)
        a, phase = rng.normal(size=6) / k, rng.uniform(0, 2 * np.pi, 6)
        h = (a * np.cos(2 * np.pi * np.outer(x, k) + phase)).sum(-1)
        return self.depth * (h - h.min()) / np.ptp(h)

    def _random(self, seed):
        rng, n = np.random.default_rng(seed), self.samples
        fx, fy = np.meshgrid(*(np.fft.fftfreq(n, period / n) for period in self.period))
        spectrum = np.exp(-(fx**2 + fy**2) / (2 * (0.3 + self.shape) ** 2)) * np.exp(2j * np.pi * rng.random((n, n)))
        h = np.fft.ifft2(spectrum).real
        return self.depth * (h - h.min()) / np.ptp(h)

    @functools.lru_cache(maxsize=64)  # noqa: B019
    def patches(self):
        """Heights (rows, columns) of each patch, µm."""
        if self.is_line:
            found = [self._profile(self.kind, self.seed + k)[None] for k in range(self.count)]
            return [h.T for h in found] if self.turned else found
        if self.kind == "crossed":
            x, y = self._profile("sinusoid", 0), self._profile("triangle", 0)
            return [x[None] + y[:, None]]
        return [self._random(self.seed + k) for k in range(self.count)]


@dataclass(frozen=True)
class At:
    """The parameters at one point of the surface."""

    orientation: float = 0.0
    height_scale: float = 1.0
    lateral_scale: float = 1.0
    film_scale: float = 1.0


@dataclass(frozen=True)
class Configuration:
    """A grating, and the light with which it is tried.

    Attributes:
        outside, coat: indices; that of a coat may be a `Cauchy`, as that of a material may.
        films: indices and thicknesses, µm, from the outside in.
        orientation, height_scale, lateral_scale, film_scale: numbers, or the values of four texels; the orientation
            also "radial" or "tangential".
        theory: scalar or rigorous.
        directions: (θ, φ, texel): degrees from the normal and from x, and which texel is hit.
        wavelengths: those of a ray, nm.
        render: whether pixels are rendered, which takes longer than all the rest.
        derived: which parameter is derived through a rendering, by which integrator and in which wrapper; or None.
    """

    surface: Surface = Surface()
    coherence_length: float = 65.0
    extent: str = "tile"
    representation: str = "auto"
    material: object = "none"
    outside: float = 1.0
    coat: float | Cauchy | None = None
    films: tuple = ()
    film_scale: float | tuple = 1.0
    transmission: str = "none"
    base: float | None = None
    orientation: float | tuple = 0.0
    height_scale: float | tuple = 1.0
    lateral_scale: float | tuple = 1.0
    shadowing: str = "v_cavity"
    conserve_energy: bool = True
    theory: str = "scalar"
    polarised: bool = False
    render: bool = False
    derived: int | None = None
    directions: tuple = ((45.0, 0.0, 0),)
    wavelengths: tuple = (450.0, 500.0, 550.0, 620.0)

    def at(self, texel):
        """The parameters at a texel, those of a film and of lengths as factors."""
        found = At(**{name: _texel(getattr(self, name), texel) for name in TEXTURES})
        if isinstance(found.orientation, str):
            u, v = uv(texel)
            angle = float(np.degrees(np.arctan2(v - 0.5, u - 0.5)))
            return replace(found, orientation=angle + 90 * (found.orientation == "tangential"))
        return found

    @property
    def densest(self):
        media = [self.outside, self.coat or 1.0, self.material if self.transmission != "none" else 1.0]
        return max(float(index_of(medium, VISIBLE[0] * 1e-3).real) for medium in media)

    @property
    def max_lateral(self):
        return float(np.max(self.lateral_scale))

    @property
    def is_resolved(self):
        """Whether orders certainly do not overlap, not even the squares about them."""
        return self.extent == "tile" and self.coherence_length >= 8 * self.max_lateral * max(self.surface.period)

    @property
    def is_discrete(self):
        """Whether the plugin evaluates orders of scalar theory one by one."""
        return self.extent == "tile" and (self.surface.is_line or self.is_resolved) and self.theory == "scalar"

    @property
    def conserves_energy(self):
        return (self.conserve_energy and self.shadowing == "v_cavity") or self.theory == "rigorous"

    @property
    def disperses(self):
        return any(isinstance(medium, Cauchy) for medium in (self.material, self.coat))

    def spectrum(self):
        """The spectrum of the surface, for all light next to the relief."""
        scale = max(1.0, float(np.max(self.height_scale)), self.max_lateral)
        if self.theory == "rigorous":
            return _rigorous(
                self.surface, self.coherence_length, self.material, self.coat or self.outside, self.transmission
            )
        return _spectrum(
            self.surface,
            self.coherence_length,
            self.extent,
            self.representation,
            (float(np.floor(0.95 * VISIBLE[0] / (self.densest * scale))), VISIBLE[1]),
        )

    def dictionary(self, **others):
        """The scene dictionary; `others` replace its entries, and leave out those that are None."""
        result = {"type": "diffraction_grating"}
        if self.surface.by_name:
            name = {"sinusoid": "sinusoidal", "triangle": "blazed"}[self.surface.kind]
            result |= {"profile": name, "period": self.surface.period[0], "depth": self.surface.depth}
            result |= {"coherence_length": self.coherence_length, "tolerance": 1e-3}
            if self.representation != "auto":
                result["representation"] = self.representation
        else:
            result["spectrum"] = self.spectrum()
        if isinstance(self.material, str):
            result["material"] = self.material
        else:
            result["int_ior"] = given(self.material)
        if self.outside != 1 or not isinstance(self.material, str):
            result["ext_ior"] = self.outside
        if self.coat is not None:
            result["coat_ior"] = given(self.coat)
            result.setdefault("ext_ior", self.outside)
        if self.films:
            result |= self.of_films()
        if self.transmission != "none":
            result["transmission"] = self.transmission
        if self.base is not None:
            result["base"] = {"type": "diffuse", "reflectance": {"type": "uniform", "value": self.base}}
        for name, default in (("orientation", 0.0), ("height_scale", 1.0), ("lateral_scale", 1.0)):
            value = getattr(self, name)
            if isinstance(value, tuple):
                result[name] = texture(value)
            elif value != default:
                result[name] = value
        if self.theory == "rigorous":
            return {name: value for name, value in (result | others).items() if value is not None}
        if self.shadowing != "v_cavity":
            result["shadowing"] = self.shadowing
        if not self.conserve_energy:
            result["conserve_energy"] = False
        result |= others
        return {name: value for name, value in result.items() if value is not None}

    def with_table_that_ends(self, name, low, high, **others):
        """The scene dictionary with a table from `low` to `high` nm in the place of the index of one parameter.

        The last of films has it; `eta` stands for both spectra of a metal.
        """
        if name == "eta":
            eta, k = spectra_that_end(self.material, low, high)
            return self.dictionary(**others, material=None, eta=eta, k=k)
        if name == "thin_film_ior":
            indices = [given(n) for n, _ in self.films]
            indices[-1] = file_that_ends(self.films[-1][0], low, high)
            value = indices[0] if len(indices) == 1 else ", ".join(map(str, indices))
        else:
            medium = {"coat_ior": self.coat, "ext_ior": self.outside}.get(name, self.material)
            value = file_that_ends(medium, low, high)
        return self.dictionary(**others, **{name: value})

    def of_films(self):
        """The parameters of the films."""
        if len(self.films) > 1:
            lists = [", ".join(str(given(values[k])) for values in self.films) for k in (0, 1)]
            result = {"thin_film_ior": lists[0], "thin_film_thickness": lists[1]}
        else:
            (n, thickness), scale = self.films[0], self.film_scale
            if isinstance(scale, tuple) and self.surface.seed % 2:  # the same by another parameter
                thicknesses = texture(tuple(thickness * s for s in scale))
                return {"thin_film_ior": given(n), "thin_film_thickness": thicknesses}
            result = {"thin_film_ior": given(n), "thin_film_thickness": thickness}
        if self.film_scale != 1:
            many = isinstance(self.film_scale, tuple)
            result["thin_film_scale"] = texture(self.film_scale) if many else self.film_scale
        return result


TEXTURES = ("orientation", "height_scale", "lateral_scale", "film_scale")


def given(medium):
    """A medium as a scene has it: a number, a name, or the file of a table."""
    return _file(medium) if isinstance(medium, Cauchy) else medium


@functools.cache
def _folder():
    return tempfile.TemporaryDirectory()


@functools.lru_cache(maxsize=4096)
def _file(medium):
    path = Path(_folder().name) / f"{medium.a:g}_{medium.b:g}.spd"
    wavelengths = np.arange(340, 861)
    path.write_text("".join(f"{w} {medium.at(w * 1e-3):.9g}\n" for w in wavelengths))
    return str(path)


def table_that_ends(medium, low, high):
    """λ in µm and n + ik of a medium from `low` to `high` nm, in rows of half a nanometre."""
    wavelengths = 1e-3 * np.append(np.arange(low, high - 0.25, 0.5), high)
    return wavelengths, index_of(medium, wavelengths)


@functools.lru_cache(maxsize=4096)
def file_that_ends(medium, low, high):
    """The file of such a table."""
    path = Path(_folder().name) / f"{hash((medium, low, high)):x}.csv"
    rows = (f"{x:.7g},{n.real:.9g},{n.imag:.9g}\n" for x, n in zip(*table_that_ends(medium, low, high), strict=True))
    path.write_text("wl,n,k\n" + "".join(rows))
    return str(path)


def spectra_that_end(medium, low, high):
    """Such a table as the spectra of η and k."""
    wavelengths, index = table_that_ends(medium, low, high)
    at = ", ".join(f"{1e3 * x:.7g}" for x in wavelengths)
    values = (", ".join(f"{v:.9g}" for v in part) for part in (index.real, index.imag))
    return [{"type": "irregular", "wavelengths": at, "values": of_part} for of_part in values]


def _texel(value, texel):
    return value[texel] if isinstance(value, tuple) else value


def texture(values):
    """Four texels in a row, as they are."""
    bitmap = mi.Bitmap(np.float32(values).reshape(1, 4, 1))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "format": "variant", "filter_type": "nearest"}


def uv(texel):
    """The centre of a texel; v varies, for orientations from the centre of UV space."""
    return (0.125 + 0.25 * texel, (0.2, 0.9, 0.35, 0.6)[texel])


@functools.lru_cache(maxsize=256)
def _spectrum(surface, coherence_length, extent, representation, wavelengths):
    pixel = tuple(t / n for t, n in zip(surface.tile, surface.patches()[0].shape[::-1], strict=True))
    patches = [md.HeightField(h, pixel) for h in surface.patches()]
    return md.precompute(
        patches if len(patches) > 1 else patches[0],
        coherence_length=coherence_length,
        extent=extent,
        representation=representation,
        wavelengths=wavelengths,
        tolerance=1e-3 if surface.is_line or extent == "tile" else 1e-2,
    )


@functools.lru_cache(maxsize=64)
def _rigorous(surface, coherence_length, material, above, transmission):
    media = {"material": material} if isinstance(material, str) else {"int_ior": material}
    (heights,) = surface.patches()
    pixel = tuple(t / n for t, n in zip(surface.tile, heights.shape[::-1], strict=True))
    return md.precompute(
        md.HeightField(heights, pixel),
        theory="rigorous",
        coherence_length=coherence_length,
        wavelengths=(VISIBLE[0] / above, VISIBLE[1] / above),
        tolerance=2e-2,
        ext_ior=above,
        transmission=transmission,
        **media,
    )


def _rounded(low, high, digits=3):
    return st.floats(low, high).map(lambda x: round(x, digits))


def _geometric(low, high):
    return st.floats(np.log(low), np.log(high)).map(lambda x: round(float(np.exp(x)), 3))


def _numbers(low, high, neutral, allowed=True):
    """A number, most often the neutral one, or four texels."""
    number = _rounded(low, high)
    if not allowed:
        return st.just(neutral)
    return st.one_of(st.just(neutral), number, st.tuples(number, number, number, number))


@st.composite
def surfaces(draw, sample=False):
    if sample:
        return Surface(
            "random",
            (round(draw(_rounded(8, 12)), 2),) * 2,
            draw(_rounded(0.02, 0.6)),
            draw(_rounded(0.1, 1)),
            draw(st.integers(0, 99)),
        )
    kind = draw(st.sampled_from(["sinusoid", "triangle", "ridges", "harmonics", "crossed", "random", "flat"]))
    is_line = kind not in ("crossed", "random")
    period = draw(_geometric(0.4, 12.0 if is_line else 4.0))
    other = period if is_line else draw(st.one_of(st.just(period), _geometric(0.6, 4.0)))
    shape = draw(st.one_of(st.just(1.0 if kind == "triangle" else 0.5), _rounded(0.05, 0.95)))
    count = draw(st.integers(1, 3)) if kind in ("harmonics", "random") else 1
    turned = is_line and draw(st.booleans())
    by_name = (kind == "sinusoid" or (kind == "triangle" and shape == 1)) and not turned and draw(st.booleans())
    return Surface(
        kind,
        (period, other),
        draw(_rounded(0.01, 1.2)),
        shape,
        draw(st.integers(0, 99)),
        turned=turned,
        count=count,
        by_name=by_name,
    )


@st.composite
def configurations(draw):
    """Draw a configuration that the plugin accepts."""
    sample = draw(st.sampled_from([False] * 9 + [True]))
    surface = draw(surfaces(sample))
    transmission = draw(st.sampled_from(["none", "none", "interface", "sheet"]))
    if not sample and draw(st.sampled_from([False] * 29 + [True])):
        return draw(rigorous(transmission))
    index = _rounded(1.05, 4.0)
    if transmission != "none" and not surface.is_line and not sample:
        # Deeper ones take a minute to load.
        surface = replace(surface, depth=min(surface.depth, 0.3), count=1)
    if transmission != "none":
        # Not 1.001: indices that differ by 1e-3 or less are taken as equal, and rounding decides which it is.
        outside = draw(st.one_of(st.just(1.0), _rounded(1.002, 1.6)))
        material = draw(st.one_of(st.just(1.5), index).filter(lambda n: abs(n - outside) > 0.03))
        if draw(st.sampled_from([False, False, False, True])):
            material = draw(media(outside + 0.03))
        coat = base = None
    else:
        material = draw(
            st.one_of(st.just("none"), st.sampled_from(METALS), index, st.sampled_from([False, True]).flatmap(_medium))
        )
        coat = draw(st.one_of(st.none(), st.just(1.5), _rounded(1.05, 2.4), media(1.05)))
        outside = 1.0
        if coat is not None or not isinstance(material, str):
            outside = draw(st.one_of(st.just(1.0), _rounded(1.002, 1.4)))
            outside = min(outside, coat_index(coat) - 0.04) if coat else outside
        base = draw(st.one_of(st.none(), _rounded(0.0, 1.0))) if not isinstance(material, str) else None
    films, film_scale = (), 1.0
    if material != "none":
        films = draw(
            st.one_of(
                st.just(()),
                st.tuples(st.tuples(film_media(), st.one_of(_rounded(0.0, 0.3), _rounded(0.0, 2.0)))),
                st.lists(st.tuples(film_media(), _rounded(0.0, 0.25)), min_size=2, max_size=12).map(tuple),
            )
        )
        if films:
            film_scale = draw(_numbers(0.3, 1.5, 1.0))
    of_media = [outside, coat or 1.0, material if transmission != "none" else 1.0]
    densest = max(float(index_of(medium, VISIBLE[0] * 1e-3).real) for medium in of_media)
    lateral = draw(_numbers(0.4, 1.0, 1.0, not sample and draw(st.booleans())))
    longest = max(surface.period) * float(np.max(lateral))
    if sample:
        coherence = draw(_rounded(2.0, 4.0))
    elif lateral != 1:
        coherence = round(max(draw(_rounded(8.5, 30)) * max(surface.period), 16.0), 2)  # not even unscaled ones overlap
    else:
        coherence = draw(
            st.one_of(
                st.just(65.0) if longest < 8 else st.nothing(),
                _rounded(8.5, 30).map(lambda x: round(x * longest, 2)),
                _rounded(0.7, 6).map(lambda x: round(max(x * longest, 1.5), 2)),
            )
        )
    # E of two-dimensional reliefs takes long, above all where scales vary.
    energy = draw(st.booleans() if surface.is_line else st.sampled_from([False, False, False, True]))
    if energy and not surface.is_line:
        lateral = 1.0
    # Half a minute where the scales of a transmitting relief vary, unless its phase does so little.
    slow = energy and transmission != "none" and surface.depth > 0.1
    if slow and isinstance(lateral, tuple):
        lateral = lateral[0]
    heights = _numbers(0.05, 1.0, 1.0, surface.is_line or not energy)
    if slow:
        heights = heights.map(lambda scale: scale[0] if isinstance(scale, tuple) else scale)
    single = surface.count == 1 and not sample and surface.kind != "flat"
    representation = "auto"
    height_range = surface.depth * (2 if surface.kind == "crossed" else 1)
    if single and surface.depth * densest < 0.8:
        representation = draw(st.sampled_from(["auto", "auto", "chebyshev", "taylor"]))
        # Taylor series of larger heights are refused: in float32 their terms cancel.
        if representation == "taylor" and height_range * densest * float(np.max(lateral)) > 0.25:
            representation = "auto"
    return Configuration(
        surface=surface,
        coherence_length=coherence,
        extent="sample" if sample else "tile",
        representation=representation,
        material=material,
        outside=outside,
        coat=coat,
        films=films,
        film_scale=film_scale,
        transmission=transmission,
        base=base,
        orientation=draw(orientations()),
        height_scale=draw(heights),
        lateral_scale=lateral,
        shadowing=draw(st.sampled_from(["v_cavity", "v_cavity", "v_cavity", "none"])),
        conserve_energy=energy,
        polarised=draw(st.sampled_from([False] * 7 + [True])),
        render=draw(st.sampled_from([False] * 11 + [True])),
        derived=draw(st.one_of(*[st.none()] * 19, st.integers(0, 999))),
        directions=draw(directions(transmission)),
        wavelengths=draw(wavelengths()),
    )


def media(least):
    """Media with dispersion, whose index in the red is at least the first argument."""
    a, b = st.floats(max(least, 1.0), 2.3), st.floats(0.0, 0.03)
    return st.builds(Cauchy, a.map(lambda x: round(x, 3)), b.map(lambda x: round(x, 4)))


def _medium(transparent):
    return media(1.05) if transparent else st.sampled_from(METALS)


def film_media():
    return st.one_of(_rounded(1.05, 4.0), st.sampled_from(METALS), media(1.1))


def coat_index(coat):
    """The least index of a coat."""
    return float(index_of(coat, VISIBLE[1] * 1e-3).real)


def orientations():
    return st.one_of(_numbers(-360, 720, 0.0), st.sampled_from(["radial", "tangential"]))


def directions(transmission):
    grazing, inclined = _rounded(85, 89.9, 2), _rounded(0, 85, 2)
    above = st.one_of(inclined, inclined, grazing)
    theta = above if transmission == "none" else st.one_of(above, above.map(lambda angle: 180 - angle))
    one = st.tuples(theta, st.one_of(st.just(0.0), _rounded(0, 360, 1)), st.integers(0, 3))
    return st.lists(one, min_size=1, max_size=3).map(tuple)


def wavelengths():
    return st.lists(_rounded(*VISIBLE, 1), min_size=4, max_size=4).map(tuple)


@st.composite
def rigorous(draw, transmission):
    """Draw a grating of rigorous theory whose table takes seconds."""
    period = draw(_rounded(0.4, 0.8, 2))
    kind = draw(st.sampled_from(["sinusoid", "triangle", "harmonics"]))
    surface = Surface(kind, (period, period), draw(_rounded(0.02, 0.12)), 0.5, draw(st.integers(0, 99)))
    material = draw(_rounded(1.3, 2.0, 2) if transmission != "none" else st.sampled_from(METALS))
    return Configuration(
        surface=surface,
        coherence_length=round(draw(_rounded(8.5, 30)) * period, 2),
        material=material,
        coat=draw(st.sampled_from([None, 1.5])) if transmission == "none" else None,
        transmission=transmission,
        orientation=draw(orientations()),
        theory="rigorous",
        render=draw(st.sampled_from([False] * 3 + [True])),
        directions=draw(directions(transmission)),
        wavelengths=draw(wavelengths()),
    )
