"""Compiled loops of the meshes: records of the PLY, triangles over a height, their deviation from it.

Import this only where it is used: Numba takes half a second.
"""

from __future__ import annotations

import math

import numpy as np

from nlights_core.frames import Array
from nlights_core.machine.compiling import inner, kernel


@kernel
def count(height: Array, rows: int) -> tuple[int, int]:
    """Known pixels of the first ``rows`` rows, and twice their whole 2 x 2, of which one row more is given."""
    vertices = faces = 0
    for i in range(rows):
        for j in range(height.shape[1]):
            vertices += height[i, j] == height[i, j]
        if i + 1 < height.shape[0]:
            upper, lower = height[i], height[i + 1]
            for j in range(height.shape[1] - 1):
                # NaN where one of the four is.
                total = upper[j] + upper[j + 1] + lower[j] + lower[j + 1]
                faces += 2 * (total == total)
    return vertices, faces


@kernel
def vertices(height: Array, colours: Array, x: Array, y: Array, camera: Array, out: Array) -> None:
    """Vertex records of a band's known pixels, in reading order.

    ``height`` (n, W) float32, ``colours`` (n, W, 1 or 3) uint8, ``x`` (W,) and ``y`` (n,) where the
    pixels' rays meet the plane, ``camera`` its place, infinitely far without perspective.
    """
    last = colours.shape[2] - 1
    k = 0
    for i in range(height.shape[0]):
        for j in range(height.shape[1]):
            z = height[i, j]
            if z == z:
                shift = z / camera[2]
                record = out[k]
                record.x = x[j] + (camera[0] - x[j]) * shift
                record.y = y[i] + (camera[1] - y[i]) * shift
                record.z = z
                record.red = colours[i, j, 0]
                record.green = colours[i, j, last // 2]
                record.blue = colours[i, j, last]
                k += 1


@kernel
def faces(height: Array, rows: int, first: int, out: Array) -> None:
    """Two triangles for each 2 x 2 of known pixels, counter-clockwise seen from the camera.

    ``height`` is of ``rows`` rows and the next; ``first`` is the number of the first known pixel.
    """
    # Numbers of the vertices of two rows, -1 where not known; their buffers change places row by row.
    upper, lower = np.empty(height.shape[1], np.int32), np.empty(height.shape[1], np.int32)
    number, k = first, 0
    for i in range(min(rows + 1, height.shape[0])):
        for j in range(height.shape[1]):
            known = height[i, j] == height[i, j]
            lower[j] = number if known else -1
            number += known
        if i > 0:
            for j in range(height.shape[1] - 1):
                a, b, c, d = upper[j], upper[j + 1], lower[j], lower[j + 1]
                if min(min(a, b), min(c, d)) >= 0:
                    out[k].corners = 3
                    out[k].a, out[k].b, out[k].c = a, c, b
                    out[k + 1].corners = 3
                    out[k + 1].a, out[k + 1].b, out[k + 1].c = b, c, d
                    k += 2
        upper, lower = lower, upper


@kernel
def split_errors(z: Array, size: int) -> Array:
    """Error that leaving out each node of a lattice makes in a right-triangulated irregular network.

    A square of ``size`` steps, a power of two, is two triangles; each triangle may be split at the
    middle of its longest side, and so on.  The error of a middle is its distance from the line
    that it would be left out for, or, if larger, that of any node that needs it: so the triangles
    whose middles exceed a tolerance make a surface without gaps.

    Parameters
    ----------
    z : (a * size + 1, b * size + 1) float32 array
        Heights at the nodes; NaN where not known.
    size : int
        Steps along a square.

    Returns
    -------
    float32 array of the same shape
        Infinite where a triangle around the node would span what is not known; 0 at the corners of the
        squares, which are always there.

    References
    ----------
    W. Evans, D. Kirkpatrick, G. Townsend, "Right-triangulated irregular networks", Algorithmica 30
    (2001) 264-286.
    """
    rows, columns = z.shape
    errors = np.zeros(z.shape, np.float32)
    half = 1
    while half < size:
        # Middles of the sides of squares of 2 x half.
        for i in range(0, rows, half):
            odd = (i // half) % 2 == 1
            for j in range(0 if odd else half, columns, 2 * half):
                # The middle's side runs down on odd lines and along the row on even ones.
                above, left = (half, 0) if odd else (0, half)
                own = _bend(z[i - above, j - left], z[i, j], z[i + above, j + left])
                step = half // 2
                if step:
                    # Middles of the next smaller triangles need this one: the round before has found them.
                    for k in (-step, step):
                        for m in (-step, step):
                            if 0 <= i + k < rows and 0 <= j + m < columns:
                                own = max(own, errors[i + k, j + m])
                errors[i, j] = own
        # Their centres: the diagonal runs through the centre of the next larger square.
        for i in range(half, rows, 2 * half):
            root = 2 * half == size
            down = half if root or (i + half) // (2 * half) % 2 == 1 else -half
            for j in range(half, columns, 2 * half):
                right = half if root or (j + half) // (2 * half) % 2 == 1 else -half
                own = _bend(z[i - down, j - right], z[i, j], z[i + down, j + right])
                own = max(max(errors[i - half, j], errors[i + half, j]), own)
                errors[i, j] = max(max(errors[i, j - half], errors[i, j + half]), own)
        half *= 2
    return errors


@inner
def _bend(first: np.float32, middle: np.float32, last: np.float32) -> np.float32:
    """Distance of a middle from the line between two ends, infinite where one is not known."""
    bend = abs(middle - (first + last) / 2)
    return bend if bend == bend else np.float32(np.inf)


@kernel
def network(
    z: Array, errors: Array, size: int, tolerance: float, number: Array, out: Array
) -> tuple[int, int]:
    """Triangles of the network that `split_errors` describes, within a tolerance.

    Parameters
    ----------
    z, errors, size
        Of `split_errors`.
    tolerance : float
        A triangle is split while the error at the middle of its longest side is larger.
    number : (h, w) int32 array
        Full of -1; gets the number of each node that is a vertex, in the order of ``out``.
    out : (F, 3) int32 array
        Gets the triangles, counter-clockwise seen from the camera; none has an unknown corner.

    Returns
    -------
    vertices, faces : int
        If ``out`` is too short, how many there would be.
    """
    # Row and column of three corners. Each level of splitting adds one triangle that waits, 128 are never reached.
    stack = np.empty((128, 6), np.int64)
    vertices = faces = 0
    for top in range(0, z.shape[0] - 1, size):
        for left in range(0, z.shape[1] - 1, size):
            bottom, right = top + size, left + size
            # Apex first, then the longest side's ends, counter-clockwise seen from the camera.
            stack[0] = (bottom, left, bottom, right, top, left)
            stack[1] = (top, right, top, left, bottom, right)
            depth = 2
            while depth:
                depth -= 1
                ai, aj, bi, bj, ci, cj = stack[depth]
                mi, mj = (bi + ci) // 2, (bj + cj) // 2
                splits = (bi + ci) % 2 == 0 and (bj + cj) % 2 == 0
                if splits and errors[mi, mj] > tolerance:
                    stack[depth] = (mi, mj, ai, aj, bi, bj)
                    stack[depth + 1] = (mi, mj, ci, cj, ai, aj)
                    depth += 2
                    continue
                total = z[ai, aj] + z[bi, bj] + z[ci, cj]
                if total != total:
                    continue
                # Past the end of ``out`` it only counts on.
                if faces < len(out):
                    for k, (i, j) in enumerate(((ai, aj), (bi, bj), (ci, cj))):
                        if number[i, j] < 0:
                            number[i, j] = vertices
                            vertices += 1
                        out[faces, k] = number[i, j]
                faces += 1
    return vertices, faces


@kernel
def deviation(
    places: Array, corners: Array, height: Array, start: int, stop: int
) -> tuple[float, float, int, int, int]:
    """Distance along z of a mesh from a height map, at every pixel of some rows that lies under it.

    Parameters
    ----------
    places : (V, 3) float64 array
        Column, row and z of the vertices.
    corners : (F, 3) integer array
        The triangles; seen along z none overlaps another.
    height : (H, W) float32 array
        NaN where not known.
    start, stop : int
        The rows.

    Returns
    -------
    largest : float
        Of all known pixels under the mesh.
    square : float
        Sum of the squares.
    compared : int
        How many pixels these are.
    reached : int
        How many pixels lie under the mesh, known or not.
    known : int
        How many are known, under it or not.
    """
    columns = height.shape[1]
    largest, square, compared, total, known = 0.0, 0.0, 0, 0, 0
    slack = 1e-6  # a vertex that lies on a pixel must reach it
    reached = np.zeros((stop - start, columns), np.bool_)
    for face in range(corners.shape[0]):
        a, b, c = places[corners[face, 0]], places[corners[face, 1]], places[corners[face, 2]]
        top = max(int(np.ceil(min(a[1], b[1], c[1]) - slack)), start)
        bottom = min(int(np.floor(max(a[1], b[1], c[1]) + slack)), stop - 1)
        if top > bottom:
            continue
        bx, by, cx, cy = b[0] - a[0], b[1] - a[1], c[0] - a[0], c[1] - a[1]
        area = bx * cy - by * cx
        if abs(area) < 1e-9:
            continue
        # Slopes of the triangle's plane per column and per row, by Cramer's rule.
        across = ((b[2] - a[2]) * cy - by * (c[2] - a[2])) / area
        down = (bx * (c[2] - a[2]) - (b[2] - a[2]) * cx) / area
        # Each side is a line that bounds the rows on one hand: where it is at row 0, and its step per row.
        turn = 1.0 if area > 0 else -1.0
        ab, bc, ca = _side(a, b, turn, slack), _side(b, c, turn, slack), _side(c, a, turn, slack)
        leftmost, rightmost = min(a[0], b[0], c[0]) - slack, max(a[0], b[0], c[0]) + slack
        for i in range(top, bottom + 1):
            low, high = leftmost, rightmost
            for on_left, place, step in (ab, bc, ca):
                low = max(low, place + step * i) if on_left > 0 else low
                high = min(high, place + step * i) if on_left < 0 else high
            left, right = max(int(np.ceil(low)), 0), min(int(np.floor(high)), columns - 1)
            plane = a[2] + down * (i - a[1]) - across * a[0]
            line, seen = height[i], reached[i - start]
            for j in range(left, right + 1):
                distance = abs(plane + across * j - line[j])
                # On a border of two triangles a pixel counts once; where the height is not known, not at all.
                counts = distance == distance and not seen[j]
                seen[j] = True
                distance = distance if counts else 0.0
                largest = distance if distance > largest else largest
                square += distance * distance
                compared += counts
    for i in range(start, stop):
        line, seen = height[i], reached[i - start]
        for j in range(columns):
            total += seen[j]
            known += line[j] == line[j]
    return largest, square, compared, total, known


@inner
def _side(first: Array, second: Array, turn: float, slack: float) -> tuple[float, float, float]:
    """Tell whether a triangle's side bounds it on the left (1), the right (-1) or not at all within a row (0).

    Then the side's column in row 0, moved outwards by ``slack``, and its columns per row.
    """
    rise = second[1] - first[1]
    if rise == 0:
        return 0.0, 0.0, 0.0
    step = (second[0] - first[0]) / rise
    hand = -turn if rise > 0 else turn
    return hand, first[0] - step * first[1] - hand * slack * math.sqrt(1 + step * step), step


@kernel
def vertex_normals(points: Array, corners: Array, out: Array) -> None:
    """Unit normals (V, 3) float32 of a mesh's vertices: means of their faces', weighted by the angles there."""
    # Sum of the normals of the faces around each vertex, by their angle there.
    total = np.zeros((len(points), 3))
    for face in range(len(corners)):
        a, b, c = points[corners[face, 0]], points[corners[face, 1]], points[corners[face, 2]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area = math.sqrt(x * x + y * y + z * z)
        if area == 0:
            continue
        uu = ux * ux + uy * uy + uz * uz
        uv = ux * vx + uy * vy + uz * vz
        first, second = math.atan2(area, uv), math.atan2(area, uu - uv)
        for k, angle in enumerate((first, second, math.pi - first - second)):
            vertex = corners[face, k]
            # The cross product is as long as twice the area; divided by that it is the face's unit normal.
            total[vertex, 0] += x * angle / area
            total[vertex, 1] += y * angle / area
            total[vertex, 2] += z * angle / area
    for i in range(len(points)):
        length = math.sqrt(total[i, 0] ** 2 + total[i, 1] ** 2 + total[i, 2] ** 2)
        for k in range(3):
            out[i, k] = total[i, k] / length if length > 0 else 1.0 * (k == 2)
