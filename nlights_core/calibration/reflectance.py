"""Reflectance of a surface that is not quite matt: white lobes of gloss, and a term of rough matt paint.

A sample of a pixel with scaled normal b (albedo times unit normal n, relative to the flat's albedo), light l relative
to the flat (u its unit vector) and view v reads

    b.l + c |b| |l| O(n) + |l| / 0.9 sum_j s_j G_j(n)

G_j is a highlight of reflectance 0.04 at normal incidence, O the cross term of Oren and Nayar.  Compiled
loops say the same in `nlights_core.calibration.compiled_reflectance`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from nlights_core.frames import Array

KINDS = ("ggx",) * 6 + ("beckmann",) * 6 + ("blinn",) * 6
"""Distribution of facets of each lobe.  GGX has tails; Beckmann's has none; Blinn's has none, and shines less in
grazing light.  Ward's lies between these two.  With GGX alone, gloss of another kind kept 0.3 mm."""

ROUGHNESSES = (
    *(0.05, 0.09, 0.15, 0.25, 0.4, 0.6),
    *(0.1, 0.14, 0.2, 0.28, 0.4, 0.6),
    *(0.1, 0.14, 0.2, 0.28, 0.4, 0.6),
)
"""Alpha of each lobe to begin with.  What lies between two lobes is not the sum of both: once the gloss is roughly
known, they are moved close to it."""

FLAT_LOBES = tuple(("ggx", roughness) for roughness in (0.2, 0.35, 0.45, 0.6))
"""Lobes that a flat may have: it is made to be matt."""

NORMAL_REFLECTANCE = 0.04
"""Of a lobe of strength 1: a varnish of refractive index 1.5."""

WHITE = 0.9
"""Albedo of the flat by which gloss is scaled; another one is another strength of the lobes."""


LEAST_REFLECTANCE, MOST_REFLECTANCE = 0.02, 0.3
"""At normal incidence, of what may be on paint: beyond these the sum of the lobes is no longer that of a varnish."""


def grazing(strength: float) -> float:
    """Growth of Fresnel's term towards grazing light, of a lobe of strength 1.

    Schlick's term F + (1 - F) x of a surface of reflectance F at normal incidence is F / 0.04 times 0.04 + g x, with
    g = 0.04 (1 / F - 1).  All lobes of a surface are of one material, so F is that of their sum: with the 0.96 of
    0.04 for all, a reflectance of 0.1 kept 0.012 mm.

    Parameters
    ----------
    strength : float
        Of all lobes together; 1: reflectance 0.04.

    Examples
    --------
    >>> round(grazing(1.0), 12), round(grazing(2.5), 12)
    (0.96, 0.36)
    """
    least, most = LEAST_REFLECTANCE / NORMAL_REFLECTANCE, MOST_REFLECTANCE / NORMAL_REFLECTANCE
    reflectance = NORMAL_REFLECTANCE * min(max(strength, least), most)
    return NORMAL_REFLECTANCE * (1 / reflectance - 1)


@dataclass(frozen=True)
class Reflectance:
    """Behaviour of a tile's surface in light, beyond that of matt paint.

    Attributes
    ----------
    gloss : (K,) float64 array
        Strength of each lobe, of the kinds `KINDS`; 1: reflectance 0.04.
    departure : float
        Share c of the cross term.
    roughnesses : (K,) float64 array
        Alpha of each lobe.
    grazing : float
        See `grazing`.
    """

    gloss: Array
    departure: float
    roughnesses: Array = field(default_factory=lambda: np.array(ROUGHNESSES))
    grazing: float = 1 - NORMAL_REFLECTANCE

    @property
    def lobes(self) -> list[tuple[str, float]]:
        """Kind and alpha of each lobe."""
        return list(zip(KINDS, self.roughnesses.tolist(), strict=True))

    @property
    def matt(self) -> bool:
        """Test whether there is nothing to take out."""
        return not self.gloss.any() and self.departure == 0


def highlights(
    normals: Array,
    lights: Array,
    views: Array,
    lobes: Sequence[tuple[str, float]],
    grazing: float = 1 - NORMAL_REFLECTANCE,
) -> Array:
    """Radiance of the lobes under light of irradiance pi across the ray, for strength 1.

    Parameters
    ----------
    normals, lights, views : (..., 3) arrays
        Unit vectors: of the surface, to the lamp, to the camera.
    lobes : sequence of (str, float)
        Kind, of `KINDS`, and alpha of each.
    grazing : float
        See `grazing`.

    Returns
    -------
    (K, ...) float64 array
        0 where the surface faces away.

    References
    ----------
    B. Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007, equations 20, 25, 27, 30,
    33, 34;
    J. F. Blinn, "Models of light reflection for computer synthesized pictures", SIGGRAPH 1977 (with the power of the
    cosine, and without masking);
    Fresnel's term by C. Schlick, "An inexpensive BRDF model", Computer Graphics Forum 13 (1994).
    """
    half = lights + views
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    along = _dot(half, views)
    fresnel = NORMAL_REFLECTANCE + grazing * (1 - along) ** 5
    upright, lit, seen = _dot(normals, half), _dot(normals, lights), _dot(normals, views)
    faces = (lit > 0) & (seen > 0) & (upright > 0)
    lit, seen = np.where(faces, lit, 1.0), np.where(faces, seen, 1.0)
    upright = np.where(faces, upright, 1.0)
    out = np.empty((len(lobes), *np.shape(lit)))
    for place, (kind, roughness) in enumerate(lobes):
        square = roughness**2
        if kind == "ggx":
            facets = square / (upright**2 * (square - 1) + 1) ** 2
            masking = _masking(lit, square) * _masking(seen, square)
        elif kind == "beckmann":
            facets = np.exp((1 - 1 / upright**2) / square) / (square * upright**4)
            masking = _masking_without_tails(lit, roughness) * _masking_without_tails(seen, roughness)
        else:
            facets = upright ** (2 / square - 2) / square
            masking = lit * seen
        out[place] = np.where(faces, facets * fresnel * masking / (4 * seen), 0)
    return out


def _masking(cosine: Array, square: float) -> Array:
    """Smith's masking of the facets of GGX, of squared roughness."""
    return np.asarray(2 * cosine / (cosine + np.sqrt(square + (1 - square) * cosine**2)))


def _masking_without_tails(cosine: Array, roughness: float) -> Array:
    """Smith's masking of the facets of Beckmann, by a rational function that is within 0.4 % of it."""
    a = cosine / (roughness * np.sqrt(np.maximum(1 - cosine**2, 1e-12)))
    return np.asarray(np.where(a < 1.6, (3.535 * a + 2.181 * a**2) / (1 + 2.276 * a + 2.577 * a**2), 1.0))


def cross_term(normals: Array, lights: Array, views: Array) -> Array:
    """Oren and Nayar's cross term times the cosine of incidence, (...).

    ``max(0, u.v - (n.u)(n.v)) / max(n.u, n.v) (n.u)``.  Unclipped it left 0.1 mm instead of 0.005.

    Parameters
    ----------
    normals, lights, views : (..., 3) arrays
        As for `highlights`.

    References
    ----------
    M. Oren, S. K. Nayar, "Generalization of Lambert's reflectance model", SIGGRAPH 1994.
    """
    lit, seen = _dot(normals, lights), _dot(normals, views)
    faces = (lit > 0) & (seen > 0)
    across = np.maximum(_dot(lights, views) - lit * seen, 0)
    return np.asarray(np.where(faces, across / np.where(faces, np.maximum(lit, seen), 1) * lit, 0))


def excess(reflectance: Reflectance, normals: Array, lights: Array, views: Array) -> tuple[Array, Array]:
    """Light that samples read beyond matt paint: white gloss, and what is added to the albedo's share.

    Parameters
    ----------
    reflectance : Reflectance
    normals, views : (..., 3) arrays
        Unit vectors.
    lights : (L, ..., 3) array
        Relative to the flat.

    Returns
    -------
    gloss : (L, ...) array
        The same in all channels.
    departure : (L, ...) array
        To be multiplied by the albedo relative to the flat.
    """
    length = np.linalg.norm(lights, axis=-1)
    unit = lights / length[..., None]
    some = [(lobe, share) for lobe, share in zip(reflectance.lobes, reflectance.gloss, strict=True) if share]
    lobes, shares = [lobe for lobe, _ in some], np.array([share for _, share in some])
    shine = np.tensordot(shares, highlights(normals, unit, views, lobes, reflectance.grazing), 1)
    return length / WHITE * shine, length * reflectance.departure * cross_term(normals, unit, views)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...k,...k->...", a, b))
