"""Reflectance of a surface that is not quite matt: white lobes of gloss, and a term of rough matt paint.

A sample of a pixel with scaled normal b (albedo times unit normal n, relative to the flat's albedo), light l relative
to the flat (u its unit vector) and view v reads

    b.l + c |b| |l| O(n) + |l| / 0.9 sum_j s_j G_j(n)

G_j is a highlight of reflectance 0.04 at normal incidence, O the cross term of Oren and Nayar.  Compiled
loops say the same in `nlights_core.calibration.compiled_reflectance`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlights_core.frames import Array

LOBES = (
    *(("ggx", roughness) for roughness in (0.05, 0.08, 0.13, 0.2, 0.275, 0.35, 0.45, 0.6)),
    *(("beckmann", roughness) for roughness in (0.12, 0.15, 0.19, 0.24, 0.3, 0.375, 0.47, 0.6)),
)
"""Distribution of facets, and alpha, of each lobe.  With three, a gloss between two of them left a level wrong by
several sigmas; without those of Beckmann, which have no tails, a gloss of that kind (or of Blinn, Phong and Ward,
which are close to it) was not measured at all."""

FLAT_LOBES = (3, 5, 6, 7)
"""Which of them a flat may have: it is made to be matt."""

NORMAL_REFLECTANCE = 0.04
"""Of a lobe of strength 1: a varnish of refractive index 1.5."""

WHITE = 0.9
"""Albedo of the flat by which gloss is scaled; another one is another strength of the lobes."""


@dataclass(frozen=True)
class Reflectance:
    """Behaviour of a tile's surface in light, beyond that of matt paint.

    Attributes
    ----------
    gloss : (K,) float64 array
        Strength of each of `LOBES`; 1: reflectance 0.04.
    departure : float
        Share c of the cross term.
    """

    gloss: Array
    departure: float

    @property
    def matt(self) -> bool:
        """Test whether there is nothing to take out."""
        return not self.gloss.any() and self.departure == 0


def highlights(
    normals: Array, lights: Array, views: Array, places: Sequence[int] = range(len(LOBES))
) -> Array:
    """Radiance of the lobes under light of irradiance pi across the ray, for strength 1.

    Parameters
    ----------
    normals, lights, views : (..., 3) arrays
        Unit vectors: of the surface, to the lamp, to the camera.
    places : sequence of int
        Of the K lobes that are wanted, among `LOBES`.

    Returns
    -------
    (K, ...) float64 array
        0 where the surface faces away.

    References
    ----------
    B. Walter et al., "Microfacet models for refraction through rough surfaces", EGSR 2007, equations 20, 25, 33, 34
    (masking as of GGX for both distributions);
    Fresnel's term by C. Schlick, "An inexpensive BRDF model", Computer Graphics Forum 13 (1994).
    """
    half = lights + views
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    along = _dot(half, views)
    fresnel = NORMAL_REFLECTANCE + (1 - NORMAL_REFLECTANCE) * (1 - along) ** 5
    upright, lit, seen = _dot(normals, half), _dot(normals, lights), _dot(normals, views)
    faces = (lit > 0) & (seen > 0) & (upright > 0)
    lit, seen = np.where(faces, lit, 1.0), np.where(faces, seen, 1.0)
    upright = np.where(faces, upright, 1.0)
    out = np.empty((len(places), *np.shape(lit)))
    for lobe, place in zip(out, places, strict=True):
        kind, roughness = LOBES[place]
        square = roughness**2
        if kind == "ggx":
            facets = square / (upright**2 * (square - 1) + 1) ** 2
        else:
            facets = np.exp((1 - 1 / upright**2) / square) / (square * upright**4)
        masking = _masking(lit, square) * _masking(seen, square)
        lobe[...] = np.where(faces, facets * fresnel * masking / (4 * seen), 0)
    return out


def _masking(cosine: Array, square: float) -> Array:
    """Smith's masking of facets, of squared roughness."""
    return np.asarray(2 * cosine / (cosine + np.sqrt(square + (1 - square) * cosine**2)))


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
    some = np.flatnonzero(reflectance.gloss)
    shine = np.tensordot(reflectance.gloss[some], highlights(normals, unit, views, some.tolist()), 1)
    return length / WHITE * shine, length * reflectance.departure * cross_term(normals, unit, views)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...k,...k->...", a, b))
