"""What must hold for every configuration. Nothing here is computed by what it judges."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from soak_grammar import TEXTURES, Configuration, given, texture, uv
from soak_model import Model, index_of, plane

from mitsuba_diffraction import testing

SAMPLES = 1 << 16
LOBE_CUTOFF = 3.8  # standard deviations, beyond which a lobe may be left out; the tolerance of 1e-3 sets 3.89
SIGMAS = 6.0  # half the side of the square about an order, in standard deviations of its lobe
DEVIATIONS = 6.0  # of an estimate, up to which it is accepted
QUADRATURE = 0.02  # relative error of the integrals on a grid
MAX_POINTS = 1_500_000  # of the grids of a configuration
VARIANTS = {False: "llvm_ad_spectral", True: "llvm_ad_spectral_polarized"}


class Fault(AssertionError):
    """An oracle was contradicted."""


@functools.cache
def fault_of(oracle):
    """An exception of its own, so that a fault does not shrink to another one."""
    return type("Fault", (Fault,), {"__doc__": oracle})


def require(condition, oracle, configuration, **numbers):
    if not condition:
        shown = "".join(f"\n  {name} = {value}" for name, value in numbers.items())
        raise fault_of(oracle)(f"{oracle}{shown}\n{configuration}")


def direction(theta, phi):
    theta, phi = np.deg2rad(theta), np.deg2rad(phi)
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


class Case:
    """A configuration, its BSDF and its model."""

    def __init__(self, configuration: Configuration):
        mi.set_variant(VARIANTS[configuration.polarised])
        self.c, self.wavelengths = configuration, np.array(configuration.wavelengths)
        self.bsdf = mi.load_dict(configuration.dictionary())
        self.model = Model(configuration)
        # Directions as they are in float32, as cosines at 89.9° are rounded by 1e-4.
        self.directions = [
            (direction(theta, phi).astype(np.float32).astype(float), texel)
            for theta, phi, texel in configuration.directions
        ]
        self.importance = mi.BSDFContext(mi.TransportMode.Importance)

    def require(self, condition, oracle, **numbers):
        require(condition, oracle, self.c, **numbers)

    def evaluate(self, wi, wo, texel, context=None, bsdf=None, factor=1.0):
        """eval and pdf at all wavelengths, times a factor."""
        return testing.evaluate_pdf(bsdf or self.bsdf, wi, wo, factor * self.wavelengths, context, uv(texel))

    def powers(self, wi, wo, radiance):
        """Power (n, c) from radiance, which grows with n² where it is refracted."""
        n_i, n_o = (self.outer(omega) for omega in (wi[None], wo))
        return radiance * (n_o / n_i) ** 2

    def outer(self, omega):
        """n (n, c) of the media of directions (n, 3)."""
        return self.model.indices((omega[:, 2] >= 0)[:, None], self.wavelengths * 1e-3)[0]

    @property
    def sides(self):
        return (False, True) if self.c.transmission != "none" else (False,)

    @functools.cached_property
    def samples(self):
        """Per direction: ω_o, weights, pdf, whether they are specular."""
        found = []
        for seed, (wi, texel) in enumerate(self.directions):
            wo, weight, bs = testing.sample(
                self.bsdf, np.tile(wi, (SAMPLES, 1)), self.wavelengths, seed + 1, None, uv(texel)
            )
            pdf = np.array(bs.pdf, float) + np.zeros(SAMPLES)
            is_delta = np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)) & np.ones(SAMPLES, bool)
            found.append((wo, weight, pdf, is_delta))
        return found

    @functools.cached_property
    def centres(self):
        """Per direction, wavelength and side: orders and their ω_o."""
        return {
            (k, channel, below): self.model.orders(wi, wavelength * 1e-3, below, self.c.at(texel))
            for k, (wi, texel) in enumerate(self.directions)
            for channel, wavelength in enumerate(self.wavelengths)
            for below in self.sides
        }


# (a) -----------------------------------------------------------------------------------------------------------------
def value_is_that_of_the_model(case: Case):
    """f at the centres of orders is that of the model times E, which is at most one, and one where a ≤ 1."""
    c, model = case.c, case.model
    if not c.is_discrete or (c.polarised and (c.coat or c.transmission == "sheet" or c.films or c.base is not None)):
        return
    tolerance = 1e-3
    for (k, channel, below), (m, wo) in case.centres.items():
        wi, texel = case.directions[k]
        if len(m) == 0:
            continue
        if not c.surface.is_line:
            m, wo = m[:: 1 + len(m) // 24], wo[:: 1 + len(m) // 24]
        at, wavelength = c.at(texel), np.full(len(m), case.wavelengths[channel] * 1e-3)
        wo = wo.astype(np.float32).astype(float)
        is_settled = settled(model, wo, wavelength)
        m, wo, wavelength = m[is_settled], wo[is_settled], wavelength[is_settled]
        if len(m) == 0:
            continue
        incident = np.repeat(wi[None], len(m), axis=0)
        expected, slack, kappa, truncated = np.zeros(len(m)), np.zeros(len(m)), None, np.zeros(len(m))
        # Neighbouring orders, where lobes overlap.
        reach = [
            0 if n == 1 or c.is_resolved else int(min(np.ceil(5 * model.sigma_q * t * at.lateral_scale), 3))
            for n, t in zip(model.patches[0].shape[::-1], model.tile, strict=True)
        ]
        for x in range(-reach[0], reach[0] + 1):
            for y in range(-reach[1], reach[1] + 1):
                common, eta, lobe, found = model.terms(incident, wo, m + np.array([x, y]), wavelength, at)
                expected, slack = expected + common * eta * lobe, slack + common * lobe
                tail = lobe * 2 * np.pi * model.sigma_q**2 < np.exp(-(LOBE_CUTOFF**2) / 2)
                truncated = truncated + np.where(tail, common * eta * lobe, 0)
                found = np.where(common * lobe > 0, found, np.inf)
                kappa = found if kappa is None else np.minimum(kappa, found)
        faces = model.face(incident, wavelength) * model.face(wo, wavelength)
        base = model.of_base(incident, wo, wavelength, at)
        cos = np.abs(wo[:, 2])
        got = case.evaluate(incident, wo, texel, case.importance)[0][:, channel] / cos
        base = base * faces * (wo[:, 2] > 0)
        expected, slack, truncated = expected * faces, slack * faces, truncated * faces
        # Where κ is small, K diverges, and the table is extrapolated.
        crosses = (wo[:, 2] > 0) != (wi[2] > 0)
        small = 2 * np.pi * np.abs(_below(c, wavelength) - c.outside) / wavelength * at.height_scale
        relative = np.where(crosses & (kappa < small), 0.03, 0.004)
        # float32 of q in a narrow lobe, and of cosines next to the horizon
        relative = relative + 3e-6 / (wavelength * model.sigma_q) + 2e-6 / cos**2 + 2e-6 / wi[2] ** 2
        # Indices are linear between nodes of 1 nm, which matters in what is left behind an absorbing film.
        depths = [4 * np.pi * index_of(n, wavelength).imag * at.film_scale * d / wavelength for n, d in c.films]
        relative = relative + 2e-3 * np.where(crosses, sum(depths), 0)
        enlarged = np.where(crosses, np.maximum(kappa, 1e-9), 1)
        enlarged = np.where(crosses, np.maximum(1, 0.25 * small / enlarged) ** 2, 1)
        floor = (1e-7 if c.is_resolved else 2e-5) / (2 * np.pi * model.sigma_q**2 * wavelength**2)
        error = relative * (expected + base) + tolerance * slack / enlarged + floor + truncated
        worst = np.argmax((got - expected - base) / error)
        note = dict(wi=wi, wavelength=wavelength[0], below=below)
        case.require(
            (got <= expected + base + error).all(),
            "(a) f above that of the model",
            **note,
            m=m[worst],
            wo=wo[worst],
            got=got[worst],
            expected=expected[worst],
            base=base[worst],
        )
        at_least = expected
        if c.conserves_energy:
            at_least = np.zeros(len(m))
            # Of transmitting reliefs E may remove more than necessary.
            if c.surface.is_line and c.transmission == "none" and gains_nothing(case, wi, wavelength[0], at):
                strong = np.flatnonzero(expected > 1e-3 * expected.max())[:12]
                for j in strong:
                    if gains_nothing(case, wo[j], wavelength[0], at):
                        at_least[j] = 0.97 * expected[j]
        worst = np.argmin((got - at_least - base) / error)
        case.require(
            (got >= at_least + base - error).all(),
            "(a) f below that of the model",
            **note,
            m=m[worst],
            wo=wo[worst],
            got=got[worst],
            expected=expected[worst],
            base=base[worst],
        )


def settled(model, omega, wavelength):
    """Whether float32 knows on which side of the horizon next to the relief directions lie, (n,).

    Inside of a flat face f has a step there: T of the face, ~ cos θ, cancels K ~ 1/cos θ.
    """
    way = model.way(omega, wavelength, 0.0)
    return np.abs(way.square + way.inner**2 - way.outer**2) > 8 * np.finfo(np.float32).eps * way.outer**2


def _below(c, wavelength):
    return index_of(c.material, wavelength).real if c.transmission != "none" else c.outside


def gains_nothing(case, omega, wavelength, at):
    """Whether the light from a direction and its neighbours certainly is no more than incident, so that E is one."""
    c = case.c
    # E is that of a perfect mirror, for all orders that propagate next to the relief.
    inside = float(case.model.above(wavelength))
    omega = np.array([*(omega[:2] * c.outside / inside), 0])
    omega[2] = np.sqrt(1 - omega @ omega)
    model = Model(replace(c, material="none", films=(), outside=inside, coat=None))
    theta, phi = np.arccos(np.clip(omega[2], -1, 1)), np.arctan2(omega[1], omega[0])
    totals = []
    for step in (0, -0.03, 0.03):
        for factor in (1, 0.97, 1.03):
            other = np.clip(abs(theta - np.pi / 2) + step, 0.005, np.pi / 2)
            z = np.sin(other) * np.sign(omega[2])
            r = np.cos(other)
            totals.append(sum(model.albedo(np.array([r * np.cos(phi), r * np.sin(phi), z]), wavelength * factor, at)))
    return max(totals) < 0.97


# (b), (c), (e) --------------------------------------------------------------------------------------------------------
def square_about(centre, sigma, fine):
    """A set about an order: a test of membership, directions on a grid, and the dω of each."""
    below, (x, y) = centre[2] < 0, centre[:2]
    r = np.hypot(x, y)
    side = 81 if fine else 41
    # Jittered where the horizon of ω_i cuts through the lobe, as the cut may run along the grid.
    rng = np.random.default_rng(11)

    def steps(*shape):
        return (np.arange(shape[-1]) + (rng.random(shape) if fine else np.full(shape, 0.5))) / shape[-1]

    if r + 1.5 * SIGMAS * sigma < 1:
        u, v = steps(side, side), steps(side, side).T
        u, v = (c + SIGMAS * sigma * (2 * np.broadcast_to(s, (side, side)).ravel() - 1) for c, s in ((x, u), (y, v)))
        z = np.sqrt(1 - u**2 - v**2)
        area = (2 * SIGMAS * sigma / side) ** 2 / z

        def contains(wo):
            near = (np.abs(wo[:, 0] - x) < SIGMAS * sigma) & (np.abs(wo[:, 1] - y) < SIGMAS * sigma)
            return near & ((wo[:, 2] < 0) == below)

    else:
        # Next to the horizon in polar coordinates, whose border is the horizon: dω = d(cos θ) dφ.
        inner, outer = max(r - SIGMAS * sigma, 0.0), min(r + SIGMAS * sigma, 1.0)
        low, high = np.sqrt(1 - outer**2), np.sqrt(1 - inner**2)
        half = min(np.pi, SIGMAS * sigma / max(inner, 1e-3))
        phi = np.arctan2(y, x)
        wide = max(side, int(side * half * max(inner, 0.1) / (SIGMAS * sigma)))
        z = (low + (high - low) * steps(wide, side)).ravel()
        f = (phi + half * (2 * steps(side, wide).T - 1)).ravel()
        rho = np.sqrt(1 - z**2)
        u, v = rho * np.cos(f), rho * np.sin(f)
        area = np.full(len(z), (high - low) / side * 2 * half / wide)

        def contains(wo):
            angle = np.angle(np.exp(1j * (np.arctan2(wo[:, 1], wo[:, 0]) - phi)))
            height = np.abs(wo[:, 2])
            return (np.abs(angle) < half) & (height > low) & (height <= high) & ((wo[:, 2] < 0) == below)

    return contains, np.stack([u, v, -z if below else z], -1), area


def samples_have_their_density_and_average_to_the_integral(case: Case):
    """∫ pdf and ∫ eval over sets on a grid are the fraction of samples in it and their mean weight."""
    for k in range(len(case.directions)):
        wo, weight, pdf, _ = case.samples[k]
        case.require(np.isfinite(weight).all() and (weight >= 0).all(), "(b) weights", k=k, worst=np.min(weight))
        case.require(np.isfinite(pdf).all() and (pdf >= 0).all(), "(c) densities", k=k)
        case.require(
            (np.abs(np.linalg.norm(wo[pdf > 0], axis=-1) - 1) < 1e-4).all(), "(c) directions of unit length", k=k
        )
    (of_orders if case.c.is_resolved else of_sphere)(case)
    for k in range(len(case.directions)):
        mirror(case, k)


def mirror_reflectance(case: Case, wi, wavelengths=None):
    """F (c,) of the face of a coat or of the flat face of a sheet, for light from ω_i; zero where there is none."""
    c, wavelengths = case.c, 1e-3 * np.asarray(case.wavelengths if wavelengths is None else wavelengths)
    cosine = np.full(len(wavelengths), abs(wi[2]))
    if c.coat:
        return plane(cosine, c.outside, [], index_of(c.coat, wavelengths), 1.0)[0]
    # In a table of rigorous theory the light of the flat face is part of the orders.
    if c.transmission == "sheet" and wi[2] < 0 and c.theory == "scalar":
        return plane(cosine, c.outside, [], index_of(c.material, wavelengths), 1.0)[0]
    return np.zeros(len(wavelengths))


def mirror(case: Case, k):
    """The specular lobe of the face of a coat or sheet has the weight F."""
    wi, _ = case.directions[k]
    _, weight, _, is_delta = case.samples[k]
    expected = mirror_reflectance(case, wi)
    if not expected.any():
        case.require(not is_delta.any(), "(b) no mirror", wi=wi)
        return
    got = np.where(is_delta[:, None], weight, 0)
    error = DEVIATIONS * got.std(0) / np.sqrt(SAMPLES) + 1e-3 * expected
    # A mirror of little power is drawn rarely.
    rare = 10 / SAMPLES if is_delta.sum() < 100 else 0
    case.require(
        (np.abs(got.mean(0) - expected) < error + rare).all(), "(b) mirror", wi=wi, got=got.mean(0), expected=expected
    )


def of_orders(case: Case):
    c, model = case.c, case.model
    total = np.zeros((len(case.directions), 4))
    sets, points = [], 0
    for (k, channel, below), (m, centres) in case.centres.items():
        outer, _ = model.indices(np.array([not below]), case.wavelengths[channel] * 1e-3)
        sigma = case.wavelengths[channel] * 1e-3 * model.sigma_q / outer[0]
        wi, _ = case.directions[k]
        for order, centre in zip(m, centres, strict=True):
            fine = min(abs(wi[2]) ** 2, centre[2] ** 2) < 40 * sigma
            sets.append((k, channel, order, *square_about(centre, sigma, fine)))
            points += len(sets[-1][-1])
    # With very many orders some of them, evenly spaced.
    every = int(np.ceil(points / MAX_POINTS))
    sets = sets[::every]
    for k, (wi, texel) in enumerate(case.directions):
        those = [s for s in sets if s[0] == k]
        if not those:
            continue
        grid, area = np.concatenate([s[4] for s in those]), np.concatenate([s[5] for s in those])
        value, density = case.evaluate(np.broadcast_to(wi, grid.shape), grid, texel)
        _check_finite(case, value, density)
        ends = np.cumsum([len(s[5]) for s in those])
        for (_, channel, order, contains, _, _), start, end in zip(those, [0, *ends], ends, strict=False):
            compare(
                case,
                k,
                contains,
                value[start:end] * area[start:end, None],
                density[start:end, 0] * area[start:end],
                area[start:end],
                note=dict(order=order, wavelength=case.wavelengths[channel], centre=grid[start:end].mean(0)),
            )
            power = case.powers(wi, grid[start:end], value[start:end] * area[start:end, None])
            # Sets of wide lobes overlap next to the horizon: each of them has its part of a point.
            sharing = sum(other[3](grid[start:end]) for other in those if other[1] == channel)
            total[k, channel] += (power[:, channel] / np.maximum(sharing, 1)).sum()
        total[k] += mirror_reflectance(case, wi)
    if every == 1 and c.conserves_energy and c.base is None:
        bound(case, total)


def _check_finite(case, value, density):
    case.require(np.isfinite(value).all() and np.isfinite(density).all(), "finite values and densities")
    case.require((value >= 0).all() and (density >= 0).all(), "values and densities not negative")


def compare(case, k, contains, value, density, area, note):
    """Compare a set's ∫ eval and ∫ pdf with the samples that fall in it; `value` and `density` are times dω."""
    wo, weight, pdf, is_delta = case.samples[k]
    inside = contains(wo) & (pdf > 0) & ~is_delta
    note = dict(wi=case.directions[k][0], **note)
    p, fraction = density.sum(), inside.mean()
    noise = DEVIATIONS * (np.sqrt(max(p, fraction) / SAMPLES) + grid_error(density)) + 20 / SAMPLES
    case.require(
        abs(p - fraction) < noise + QUADRATURE * max(p, fraction),
        "(c) ∫ pdf = fraction drawn",
        **note,
        integral=p,
        fraction=fraction,
        noise=noise,
    )
    integral = value.sum(0)
    found = np.where(inside[:, None], weight, 0)
    # The variance from the grid as well, as few samples may have most of it.
    with np.errstate(divide="ignore", invalid="ignore"):
        square = np.where(density[:, None] > 0, value**2 / density[:, None], 0).sum(0)
    variance = np.maximum(np.maximum(square - integral**2, 0), found.var(0))
    noise = DEVIATIONS * (np.sqrt(variance / SAMPLES) + grid_error(value)) + 10 * found.max(0) / SAMPLES
    ratio = np.where(density[:, None] > 0, value / np.maximum(density[:, None], 1e-30), 0)
    noise += 20 * ratio.max(0) / SAMPLES
    # Between narrow peaks of which the grid has none; the cut-off tail of another lobe between its outermost points.
    floor = 1e-5 if case.c.is_resolved else 1e-4
    bad = np.abs(found.mean(0) - integral) > noise + QUADRATURE * integral + floor
    case.require(not bad.any(), "(b) ∫ eval = mean weight", **note, integral=integral, mean=found.mean(0), noise=noise)
    undrawable = (density <= 0) & (value.sum(-1) > 0)
    case.require(value[undrawable].sum(0).max(initial=0) < 1e-4, "(c) light that is never drawn", **note, lost=integral)


def grid_error(terms):
    """The standard error of a sum over jittered points, from the differences of neighbours; a bound for a regular grid.

    Lobes of transmitted light may be narrower than a grid over the sphere resolves.
    """
    even = len(terms) // 2 * 2
    return np.sqrt(((terms[0:even:2] - terms[1:even:2]) ** 2).sum(0))


def of_sphere(case: Case):
    """As `of_orders`, over bins of the sphere with grids that are denser towards the horizon."""
    c = case.c
    rng = np.random.default_rng(5)
    edges = np.array([0, 0.03, 0.08, 0.17, 0.3, 0.45, 0.6, 0.75, 0.9, 0.97, 1.0])
    sigma = np.min(case.wavelengths) * 1e-3 * case.model.sigma_q / c.densest
    per_sector = int(np.clip(np.ceil(2 * np.pi / 16 / (0.7 * sigma)), 10, 60))
    per_ring = int(np.clip(np.ceil(0.15 / (0.7 * sigma)), 8, 40))
    for k, (wi, texel) in enumerate(case.directions):
        for below in case.sides:
            z, step = [], []
            for low, high in itertools.pairwise(edges):
                z.append(np.linspace(low, high, per_ring + 1)[:-1])
                step.append(np.full(per_ring, (high - low) / per_ring))
            z, step = np.concatenate(z), np.concatenate(step)
            count = 16 * per_sector
            phi = np.arange(count) * 2 * np.pi / count
            # Jittered, so that steps of the density do not beat with the grid.
            z = z[:, None] + step[:, None] * rng.random((len(z), count))
            phi = phi + 2 * np.pi / count * rng.random(z.shape)
            rho = np.sqrt(1 - np.minimum(z, 1) ** 2)
            grid = np.stack([rho * np.cos(phi), rho * np.sin(phi), -z if below else z], -1).reshape(-1, 3)
            area = np.repeat(step * 2 * np.pi / count, count)
            value, density = case.evaluate(np.broadcast_to(wi, grid.shape), grid, texel)
            _check_finite(case, value, density)
            ring = np.clip(np.searchsorted(edges, np.abs(grid[:, 2]), side="right") - 1, 0, len(edges) - 2)
            sector = (np.arctan2(grid[:, 1], grid[:, 0]) % (2 * np.pi) / (2 * np.pi) * 16).astype(int) % 16
            for r in range(len(edges) - 1):
                for s in range(16):
                    of_bin = (ring == r) & (sector == s)

                    def contains(wo, r=r, s=s, below=below):
                        height = np.abs(wo[:, 2])
                        angle = (np.arctan2(wo[:, 1], wo[:, 0]) % (2 * np.pi) / (2 * np.pi) * 16).astype(int) % 16
                        in_ring = (height >= edges[r]) & (height < edges[r + 1] + (r == len(edges) - 2))
                        return in_ring & (angle == s) & ((wo[:, 2] < 0) == below)

                    note = dict(ring=(edges[r], edges[r + 1]), sector=s, below=below)
                    terms = value[of_bin] * area[of_bin, None], density[of_bin, 0] * area[of_bin], area[of_bin]
                    try:
                        compare(case, k, contains, *terms, note=note)
                    except Fault:
                        # A narrow lobe may lie between the points.
                        compare(case, k, contains, *finer(case, k, edges[r : r + 2], s, below), note=note)
    if c.conserves_energy and c.base is None:
        # From samples, whose density was just compared: the grid is too coarse for a sum over narrow peaks.
        total, error = np.zeros((2, len(case.directions), 4))
        for k, (wi, _) in enumerate(case.directions):
            wo, weight, _, is_delta = case.samples[k]
            power = case.powers(wi, np.where(is_delta[:, None], wi, wo), weight)
            total[k], error[k] = power.mean(0), DEVIATIONS * power.std(0) / np.sqrt(SAMPLES)
        bound(case, total - error)


def finer(case: Case, k, ring, sector, below, count=300_000):
    """Value and density, times dω, and dω at random points of a bin of the sphere."""
    rng = np.random.default_rng(13)
    z, phi = rng.uniform(*ring, count), (sector + rng.random(count)) * 2 * np.pi / 16
    rho = np.sqrt(1 - np.minimum(z, 1) ** 2)
    points = np.stack([rho * np.cos(phi), rho * np.sin(phi), -z if below else z], -1)
    area = np.full(count, (ring[1] - ring[0]) * 2 * np.pi / 16 / count)
    wi, texel = case.directions[k]
    value, density = case.evaluate(np.broadcast_to(wi, points.shape), points, texel)
    return value * area[:, None], density[:, 0] * area, area


def bound(case: Case, total):
    """(e) R + T ≤ bound; more is documented from inside of glass just below the critical angle."""
    c = case.c
    for (wi, _), of_direction in zip(case.directions, total, strict=True):
        limit = 1.02 if wi[2] > 0 or c.transmission == "sheet" else 1.10
        if c.theory == "rigorous":
            # Tables have a mean error of 0.02, and a larger one at the horizon and near Rayleigh anomalies. Of 14
            # tables of interfaces, 21000 directions, no sum exceeded 1.011 plus the maximum error of the table.
            table = case.bsdf.layers.grating.spectrum
            limit += max(0.06 if abs(wi[2]) < 0.1 else 0.03, table.max_error)
        elif c.transmission == "interface" and is_narrow(c):
            # Measured: one in 300 directions, see test_orders_in_a_medium_that_begin_between_nodes_of_e.
            limit = 2.5
        case.require((of_direction < limit + 0.015).all(), "(e) R + T ≤ bound", wi=wi, got=of_direction, limit=limit)


def is_narrow(c):
    """Whether the relief is more than half as deep as its period."""
    return c.surface.depth * np.max(c.height_scale) > 0.5 * min(c.surface.period) * np.min(c.lateral_scale)


# (d) -----------------------------------------------------------------------------------------------------------------
def pairs(case: Case, count=200):
    """Pairs of directions in lobes and outside of them."""
    rng = np.random.default_rng(3)
    for k, (wi, texel) in enumerate(case.directions):
        found = [np.zeros((0, 3))]
        if case.c.is_discrete:
            found += [wo[:: max(1, len(wo) // 40)] for key, (_, wo) in case.centres.items() if key[0] == k]
        other = rng.normal(size=(count, 3))
        other /= np.linalg.norm(other, axis=-1, keepdims=True)
        if case.c.transmission == "none":
            other[:, 2] = np.abs(other[:, 2])
        found = np.concatenate([*found, other])
        sigma = 0.5 * case.model.sigma_q
        found[:, :2] += sigma * rng.normal(size=(len(found), 2))
        square = (found[:, :2] ** 2).sum(-1)
        found = found[square < 0.9999]
        found[:, 2] = np.sign(found[:, 2]) * np.sqrt(1 - square[square < 0.9999])
        yield np.repeat(wi[None], len(found), axis=0), found, texel


def is_reciprocal(case: Case):
    # Of scales that vary, at each texel.
    texels = range(4) if any(isinstance(getattr(case.c, name), tuple) for name in TEXTURES) else [None]
    for (wi, wo, own), other in itertools.product(pairs(case), texels):
        texel = own if other is None else other
        n_i, n_o = (case.outer(omega) for omega in (wi, wo))
        there = case.evaluate(wi, wo, texel, case.importance)[0] / (np.abs(wo[:, [2]]) * n_o**2)
        back = case.evaluate(wo, wi, texel, case.importance)[0] / (np.abs(wi[:, [2]]) * n_i**2)
        radiance = case.evaluate(wi, wo, texel)[0] / (np.abs(wo[:, [2]]) * n_i**2)
        # float32 of q at the edge of a narrow lobe, where it is cut off, and of cosines at the horizon
        scale = np.maximum(there, back)
        relative = 0.01 + 3e-5 / np.minimum(np.abs(wi[:, 2]), np.abs(wo[:, 2])) ** 2
        # In polarised variants 1 − R of total reflection is not exactly zero, and K grows as 1/(cos θ_i cos θ_o).
        rounding = (1e-7 if case.c.polarised else 0.0) / np.abs(wi[:, 2] * wo[:, 2])
        floor = 1e-3 * scale.max(initial=0) + 1e-5 + rounding[:, None]
        bad = np.abs(there - back) > relative[:, None] * scale + floor
        j = np.argmax(bad.any(-1))
        case.require(
            not bad.any(),
            "(d) reciprocity",
            **{"wi": wi[j], "wo": wo[j], "texel": texel, "there": there[j], "back": back[j], "count": bad.sum()},
        )
        # Polarised variants multiply the faces in another order, with other rounding errors.
        floor = 1e-6 * scale.max(initial=0) + 1e-7 + rounding[:, None]
        bad = np.abs(there - radiance) > 0.1 * relative[:, None] * scale + floor
        j = np.argmax(bad.any(-1))
        case.require(not bad.any(), "(d) radiance scales with n²", wi=wi[j], wo=wo[j], there=there[j], got=radiance[j])


# (f), (g), (h) --------------------------------------------------------------------------------------------------------
def same(case: Case, other, oracle, tolerance=2e-4, density=True, reference=None, other_material=False, **numbers):
    """Whether another BSDF has the same values, and the same densities if those of its tables are the same."""
    for wi, wo, texel in pairs(case):
        a, b = (case.evaluate(wi, wo, texel, bsdf=bsdf) for bsdf in (reference, other))
        for name, x, y, relative in (("value", a[0], b[0], tolerance), ("pdf", a[1], b[1], 10 * tolerance))[
            : 1 + density
        ]:
            scale = max(x.max(initial=0), y.max(initial=0))
            if name == "value" and other_material:
                # T = O(cos θ) of a facet near the critical angle, where float32 rounds cos² θ.
                relative = relative + np.finfo(np.float32).eps / facet_cosines(case, wi, wo) ** 2
            error = relative * np.maximum(x, y) + 1e-5 * scale + 1e-6
            bad = np.abs(x - y) > error
            if bad.any():
                # Rounded indices decide on which side of the horizon an order is.
                kind = int(name == "pdf")
                near = [case.evaluate(wi, wo, texel, bsdf=reference, factor=1 + s * 4e-6)[kind] for s in (-1, 1)]
                low, high = np.minimum(*near), np.maximum(*near)
                bad &= (y < 0.99 * low - error) | (y > 1.01 * high + error)
            j = np.argmax(bad.any(-1))
            case.require(
                not bad.any(), oracle, what=name, wi=wi[j], wo=wo[j], got=y[j], wanted=x[j], count=bad.sum(), **numbers
            )


def facet_cosines(case: Case, wi, wo):
    """The smaller cosine (n, c) of the angles that ω_i and ω_o have with the facet that scatters one into the other."""
    wavelengths = 1e-3 * np.asarray(case.wavelengths)
    found = []
    for wavelength in wavelengths:
        i, o = (case.model.way(omega, np.full(len(omega), wavelength), 0.0) for omega in (wi, wo))
        v_z = i.sign * i.normal(i.square) + o.sign * o.normal(o.square)
        square = ((i.tangent + o.tangent) ** 2).sum(-1) + v_z**2
        excess = np.where(i.sign == o.sign, 0, i.inner**2 - o.inner**2)
        cosines = np.abs(square + excess) / i.inner, np.abs(square - excess) / o.inner
        found.append(np.minimum(*cosines) / (2 * np.sqrt(np.maximum(square, 1e-18))))
    return np.maximum(np.stack(found, -1), 1e-9)


def update_is_a_fresh_scene(case: Case):
    """(f) Another configuration, updated to this one by `mi.traverse`."""
    c, changes, values = case.c, {}, {}
    rng = np.random.default_rng(7)
    factor = 0.5 + 0.4 * rng.random()
    names = {name: name for name in TEXTURES[:3] if c.theory == "scalar" or name == "orientation"}
    if c.films:
        names["film_scale"] = "thin_film_scale"
    for name, parameter in names.items():
        value = getattr(c, name)
        if isinstance(value, str) or (name in ("lateral_scale", "film_scale") and value == 1):
            continue
        changes[name] = tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value
        if isinstance(value, tuple):
            is_thickness = name == "film_scale" and "thin_film_scale" not in c.of_films()
            texels = c.films[0][1] * np.array(value) if is_thickness else np.array(value)
            parameter = "thin_film_thickness" if is_thickness else parameter
            values[f"{parameter}.data"] = np.float32(texels).reshape(1, 4, 1)
        else:
            values[parameter + (".value" if name == "orientation" else "")] = value
    if isinstance(c.material, float) and c.material > 1.1 and c.theory == "scalar":
        lower = 1.02 + (c.material - 1.02) * factor
        # The parameter is relative to the index in the middle of visible light, at √(360 · 830) nm.
        relative = index_of(c.coat or c.outside, np.sqrt(0.36 * 0.83)).real if c.transmission == "none" else c.outside
        is_recipe = c.surface.by_name and c.transmission != "none"  # for the light inside of the first index
        if abs(lower - c.outside) > 0.03 and (lower > c.outside) == (c.material > c.outside) and not is_recipe:
            changes["material"] = lower
            # Rounded as in a scene: at the horizon of the lower medium T follows the last bit.
            values["eta"] = float(np.float32(c.material)) / float(np.float32(relative))
    if c.films and "thin_film_thickness.data" not in values:
        changes["films"] = tuple((n, factor * thickness) for n, thickness in c.films)
        values["thin_film_thickness"] = [thickness for _, thickness in c.films]
    if c.base is not None:
        changes["base"] = factor * c.base
        values["base.reflectance.value"] = c.base
    # The spectrum is that of this configuration.
    before = replace(c, **changes).dictionary(**({} if c.surface.by_name else {"spectrum": c.spectrum()}))
    other = mi.load_dict(before)
    parameters = mi.traverse(other)
    for key, value in values.items():
        case.require(key in parameters, "(f) parameters", missing=key, known=list(parameters.keys()))
        parameters[key] = mi.TensorXf(value) if isinstance(value, np.ndarray) else mi.Float(value)  # or a list
    parameters.update()
    same(case, other, "(f) update = fresh load", changed=list(values))


def saved_is_in_memory(case: Case, folder):
    """(g) A spectrum that was saved and loaded."""
    # Saving computes the table of E, which takes long: a fifth of all surfaces is saved.
    if case.c.surface.by_name or case.c.surface.seed % 5:
        return
    path = folder / "spectrum.exr"
    path.unlink(missing_ok=True)
    case.c.spectrum().save(path)
    dictionary = case.c.dictionary(spectrum=None, filename=str(path))
    same(case, mi.load_dict(dictionary), "(g) saved and loaded = in memory", 1e-5)


def neutral_parameters_change_nothing(case: Case):
    """(h) A film of no thickness or of an index beside it, a coat of the index outside, scales of one, 360°."""
    c, changed = case.c, []
    if c.theory == "rigorous":
        return
    if not c.films and c.material != "none":
        above = given(c.outside if c.coat is None else c.coat)
        changed += [
            ("film of no thickness", {"thin_film_ior": 2.0, "thin_film_thickness": 0.0}),
            ("film of the index below", {"thin_film_ior": given(c.material), "thin_film_thickness": 0.1}),
            (
                "films of the index below",
                {"thin_film_ior": f"2 x ({given(c.material)})", "thin_film_thickness": "0.1, 0.2"},
            ),
            ("film of the index above", {"thin_film_ior": above, "thin_film_thickness": 0.1}),
        ]
    if c.coat is None and c.transmission == "none":
        changed.append(("coat of the index outside", {"coat_ior": c.outside, "ext_ior": c.outside}))
    if c.height_scale == 1:
        changed.append(("texture of scales of one", {"height_scale": texture((1.0,) * 4)}))
    if isinstance(c.orientation, str):
        pass
    elif isinstance(c.orientation, tuple):
        changed.append(("360° more", {"orientation": texture(tuple(v + 360 for v in c.orientation))}))
    else:
        changed.append(("360° more", {"orientation": c.orientation + 360.0}))
        changed.append(("texture of one orientation", {"orientation": texture((c.orientation,) * 4)}))
    # Without E, which is stored in bytes and has other tables with a film, as the sampler has; (e) judges it.
    plain = mi.load_dict(c.dictionary(conserve_energy=False))
    for name, others in changed:
        other = mi.load_dict(c.dictionary(**others, conserve_energy=False))
        of_film = name.startswith("film")
        same(case, other, f"(h) {name} = without", 2e-3, density=False, reference=plain, other_material=of_film)


# (j) -----------------------------------------------------------------------------------------------------------------
VISIBLE = (360.0, 830.0)


def tables_hold_where_they_end(case: Case):
    """(j) A table that ends in the place of an index: refused in white light, the same in light inside of it."""
    c = case.c
    if c.theory == "rigorous":
        return
    low, high = min(*c.wavelengths, 540.0) - 3, max(*c.wavelengths, 550.0) + 3  # with the nominal wavelength
    plain = c.dictionary(conserve_energy=False)
    named = [name for name in ("int_ior", "ext_ior", "coat_ior", "thin_film_ior") if name in plain]
    named += ["material", "eta"] if c.material not in ("none", None) and "material" in plain else []
    if not named or (low <= VISIBLE[0] and high >= VISIBLE[1]):
        return
    name = named[c.surface.seed % len(named)]
    ended, refusal = c.with_table_that_ends(name, low, high, conserve_energy=False), None
    try:
        mi.load_dict(seen(ended, VISIBLE))
    except RuntimeError as error:
        refusal = str(error)
    wanted = f"{name}: got light of 360 to 830 nm, and a table of {max(low, 0):g} to {high:g} nm"
    case.require(
        refusal is not None and wanted in refusal, "(j) refused outside of a table", got=refusal, wanted=wanted
    )
    # Spectra by name are for the densest index that is known, and equal within their tolerance alone.
    c = replace(c, surface=replace(c.surface, by_name=False))
    plain = c.dictionary(conserve_energy=False)
    inside = mi.load_dict(seen(c.with_table_that_ends(name, low, high, conserve_energy=False), (low, high)))
    same(
        *(case, inside.shapes()[0].bsdf(), "(j) the same inside of a table", 1e-3),
        **{"density": False, "reference": mi.load_dict(plain), "other_material": True, "name": name},
    )


def seen(bsdf, wavelengths):
    """A scene of a BSDF in the light of wavelengths (shortest, longest)."""
    first, last = wavelengths
    band = {"type": "regular", "wavelength_min": first, "wavelength_max": last, "values": "1, 1"}
    film = {"type": "specfilm", "width": 2, "height": 2, "band": band}
    light = {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}
    plate = {"type": "rectangle", "bsdf": bsdf}
    return {"type": "scene", "sensor": {"type": "perspective", "film": film}, "light": light, "plate": plate}


# (i) -----------------------------------------------------------------------------------------------------------------
PIXELS, SAMPLES_PER_PIXEL = 8, 1 << 13
INTEGRATORS = {
    "path": {"type": "path", "max_depth": 2},
    "diffraction_path": {"type": "diffraction_path", "max_depth": 3},
    "emitter samples": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
}


def integrators_agree(case: Case):
    """(i) A plate under sky, lamp and sun looks the same whether its directions are drawn or the lights are."""
    c = case.c
    if c.polarised or not c.render:
        return
    c = replace(c, **{name: getattr(c.at(0), name) for name in TEXTURES})
    wi, _ = case.directions[0]
    if abs(wi[2]) < 0.05:  # the pixel would be wider than the plate
        return
    below = wi[2] < 0
    z = -1.0 if below else 1.0
    # Half above and half below, so that transmitted light is part of it.
    lamp = np.array([0.5, 0.3, 0.8 * (1 if len(case.directions) == 1 or c.transmission == "none" else -1)]) * [1, 1, z]
    uniform = {"type": "uniform", "value": 1.0}
    lights = {
        "sky": {"type": "constant", "radiance": uniform},
        "lamp": {
            **{"type": "sphere", "center": [float(v) for v in 4 * lamp], "radius": 1.2},
            "emitter": {"type": "area", "radiance": uniform},
        },
        "sun": {"type": "directional", "direction": [float(v) for v in -lamp], "irradiance": uniform},
    }
    to_world = mi.ScalarTransform4f().look_at([float(v) for v in 3 * wi], [0, 0, 0], [0.1, 1, 0.2])
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "luminance", "component_format": "float32"}
    sensor = {"type": "perspective", "fov": 0.05, "to_world": to_world, "film": film}
    has_mirror = c.coat is not None or (c.transmission == "sheet" and below)
    for name, light in lights.items():
        plate = {"type": "rectangle", "bsdf": c.dictionary()}
        scene = mi.load_dict({"type": "scene", "sensor": sensor, "plate": plate, "light": light})
        means, errors = {}, {}
        for integrator, dictionary in INTEGRATORS.items():
            if integrator == "emitter samples" and name == "lamp" and has_mirror:
                continue
            image = mi.render(scene, integrator=mi.load_dict(dictionary), spp=SAMPLES_PER_PIXEL, seed=len(means))
            pixels = np.array(image, float).ravel()
            means[integrator], errors[integrator] = pixels.mean(), pixels.std() / PIXELS
        if "emitter samples" in means and name == "sky" and has_mirror:
            means["emitter samples"] += mirror_reflectance(case, wi, [555.0])[0] * luminance_of_one()
        for integrator in list(means)[1:]:
            if errors[integrator] > 0.05 * means["path"]:
                continue  # rare samples in a narrow lobe: the error is not known either
            error = DEVIATIONS * np.hypot(errors["path"], errors[integrator]) + QUADRATURE * means["path"]
            case.require(
                abs(means["path"] - means[integrator]) < error + 1e-6,
                f"(i) path = {integrator} under {name}",
                means=means,
                errors=errors,
                wi=wi,
            )


@functools.cache
def luminance_of_one():
    """What a pixel shows of the sky alone."""
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "luminance", "component_format": "float32"}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film}, "sky": sky})
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=4096)).mean()


# (j) -----------------------------------------------------------------------------------------------------------------
WRAPPERS = (
    lambda bsdf: bsdf,
    lambda bsdf: {"type": "blendbsdf", "weight": 0.7, "a": {"type": "diffuse"}, "b": bsdf},
    lambda bsdf: {"type": "mask", "opacity": 0.8, "bsdf": bsdf},
)
STEPS = {"orientation": 0.02, "lateral_scale": 2e-4, "thin_film_thickness": 5e-4}  # of others 5e-3


def derivatives_are_differences(case: Case):
    """(j) dr.backward through mi.render, by any parameter of mi.traverse, is the difference of two pictures.

    They have the samples of the derivative, and light of the sun, so that no direction that is drawn matters. E is left
    out, as other scales have other tables of it.
    """
    c = case.c
    (wi, texel), wavelength = case.directions[0], case.wavelengths[0]
    if c.derived is None or c.polarised or abs(wi[2]) < 0.1:
        return
    m, wo = case.model.orders(wi, wavelength * 1e-3, bool(wi[2] < 0), c.at(texel))
    m, wo = (x[np.abs(wo[:, 2]) > 0.1] for x in (m, wo))
    if not len(wo):
        return
    # On the slope of the lobe of an order.
    j = c.derived % len(wo)
    sun = wo[j] + 0.7 * wavelength * 1e-3 * case.model.sigma_q * np.array([0.6, 0.8, 0])
    # An order whose exact direction, from either side, crosses the horizon appears at once: no derivative has that.
    index = case.model.indices(np.array([wi[2] >= 0, sun[2] >= 0]), wavelength * 1e-3)[0]
    half_width = 4 * wavelength * 1e-3 * case.model.sigma_q / index
    if (np.hypot(*np.transpose([wi, sun])[:2]) / np.linalg.norm([wi, sun], axis=1) + half_width > 1).any():
        return
    film = {"type": "specfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "component_format": "float32"}
    low, high = max(wavelength - 30, VISIBLE[0]), min(wavelength + 30, VISIBLE[1])
    film["band"] = {"type": "regular", "wavelength_min": low, "wavelength_max": high, "values": "1, 1"}
    to_world = mi.ScalarTransform4f().look_at([float(v) for v in 3 * wi], [0, 0, 0], [0.1, 1, 0.2])
    bsdf = WRAPPERS[c.derived % len(WRAPPERS)](c.dictionary(conserve_energy=False if c.theory == "scalar" else None))
    kind = ("path", "prb", "diffraction_path")[c.derived // 3 % 3]
    scene = mi.load_dict(
        {
            **{"type": "scene", "integrator": {"type": kind, "max_depth": 3}},
            "sensor": {"type": "orthographic", "to_world": to_world @ mi.ScalarTransform4f().scale(0.3), "film": film},
            "plate": {"type": "rectangle", "bsdf": bsdf},
            "sun": {"type": "directional", "direction": [float(-v) for v in sun], "irradiance": 1.0},
            # Without it `path` has no light where a mask is crossed (Mitsuba 3.9.1, any BSDF below the mask).
            "sky": {"type": "constant", "radiance": {"type": "uniform", "value": 1e-9}},
        }
    )
    parameters = mi.traverse(scene)
    fixed = ["to_uv", "to_world", "weight", "opacity", "a.reflectance"]
    if c.lateral_scale == 1 and not (c.is_resolved and c.coherence_length >= 16):
        fixed.append("lateral_scale")  # refused with a derivative where orders overlap
    keys = [
        key
        for key in parameters.keys()  # noqa: SIM118
        if ".bsdf." in key
        and not any(part in key for part in fixed)
        and not parameters.flags(key) & mi.ParamFlags.NonDifferentiable.value  # such as the range of a spectrum
    ]
    key = keys[c.derived % len(keys)]
    name = next((part for part in key.split(".") if part in STEPS), "")
    step, start, like = STEPS.get(name, 5e-3), np.array(parameters[key], np.float32), type(parameters[key])
    samples = dict(spp=256)
    if name != "orientation" and start.min() < 2 * step:
        return  # of a film of no thickness or a black base: there are no negative ones

    def total(change):
        parameters[key] = like(start + np.float32(change))
        parameters.update()
        return np.array(mi.render(scene, seed=1, **samples), float).sum()

    brightness = total(0.0)
    if brightness < 1e-3:  # the light of the sky
        return
    fraction = 1.0
    if c.theory == "scalar" and c.is_discrete:
        band = np.linspace(low, high, 61) * 1e-3
        incident, exit_, order = (np.repeat(v[None], 61, axis=0) for v in (wi, sun / np.linalg.norm(sun), m[j]))
        common, eta, lobe, _ = case.model.terms(incident, exit_, order, band, c.at(texel))
        # Of the power of all orders.
        fraction = max((common * eta * lobe).sum() / (common * lobe).sum(), 1e-3)
    x = like(start)
    dr.enable_grad(x)
    parameters[key] = x
    parameters.update()
    dr.backward(dr.sum(mi.render(scene, parameters, seed=0, seed_grad=1, **samples), axis=None))
    found = np.array(dr.grad(x), float).sum()
    # Where the tables of two intervals of κ meet, or light interferes in thick films, differences of two steps differ.
    differences = [(total(s) - total(-s)) / (2 * s) for s in (step / 2, step, 2 * step)]
    wanted, error = differences[0], 3 * np.abs(np.diff(differences)).max()
    error += 0.03 * abs(wanted)
    # Between intervals of κ a table has steps of up to its tolerance, a fraction of the power of all orders.
    error += 1e-3 * brightness / fraction / max(np.abs(start).max(initial=0), 0.1)
    case.require(
        np.isfinite(found) and abs(found - wanted) <= error,
        f"(j) derivative by {key.partition('.bsdf.')[2]} through {kind} = difference",
        found=found,
        wanted=wanted,
        differences=differences,
    )


ORACLES = {
    "value": value_is_that_of_the_model,
    "density": samples_have_their_density_and_average_to_the_integral,
    "reciprocity": is_reciprocal,
    "update": update_is_a_fresh_scene,
    "saved": saved_is_in_memory,
    "neutral": neutral_parameters_change_nothing,
    "tables": tables_hold_where_they_end,
    "integrators": integrators_agree,
    "derivatives": derivatives_are_differences,
}


def judge(configuration: Configuration, folder, oracles=tuple(ORACLES)):
    """Apply oracles to a configuration."""
    case = Case(configuration)
    for name in oracles:
        if name == "saved":
            ORACLES[name](case, folder)
        else:
            ORACLES[name](case)
    dr.sync_thread()
