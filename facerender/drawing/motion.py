"""Motion vectors: the displacement of the visible surface points since the frame before. The driver
only finds the visible triangles; the displacements are computed in float64."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from facerender.drawing.frame_passes import INDEX_BASE
from facerender.drawing.prepare import ResolvedPart
from facerender.errors import InputError
from facerender.scene.scene import Scene
from facerender.scene.view import View
from facerender.values.vectors import Float, Float32, Integers, Size

# Displacements are rounded to 1e-6 pixels, because two poses of one mesh may use renderer's spaces
# of different centre. Rounding errors of float64 then leave static points at 0.
_DIGITS = 6
_XYW = [0, 1, 3]  # indices of clip x, y and w


def pixel_centres(size: Size) -> Float:
    """Return the centre (H * W, 2) of each pixel of an image, row by row."""
    return np.stack(np.divmod(np.arange(math.prod(size)), size[0])[::-1], axis=-1) + 0.5


def check_before(scene: Scene) -> Scene:
    """Return the scene before. Raises InputError without one, or for other triangles."""
    if (before := scene.before) is None:
        remedy = "give the scene of that frame as Scene(..., before=SCENE)"
        raise InputError(f"motion of {scene.mesh.name} needs the frame before: {remedy}")
    faces, old_faces = ([part.faces for part in frame.mesh.parts] for frame in (scene, before))
    pairs = zip(faces, old_faces, strict=False)
    if len(faces) != len(old_faces) or not all(a is b or np.array_equal(a, b) for a, b in pairs):
        names = f"{scene.mesh.name} and {before.mesh.name} of the frame before"
        remedy = "give two poses of one mesh, from Mesh.with_positions"
        raise InputError(f"{names} have different triangles: {remedy}")
    return before


def motion_vectors(
    scene: Scene,
    before: Scene,
    views: tuple[View, View],
    parts: Sequence[ResolvedPart],
    triangles: Float32,
    flat: View,
    rays: Float,
) -> Float32:
    """Return the motion vectors of a scene as an image (H, W, 4) float32; see ``Frame.linear``.

    before : the result of :func:`check_before`
    views : the camera of this frame, and that of the frame before
    parts, triangles : the parts of ``triangle_pass``, and the values of this pass, (H, W, 4)
    flat : the camera of this frame without lens distortion
    rays : (H * W, 2), positions of the pixels' centres in the image of this camera, from -1 to 1
    """
    size = triangles.shape[1::-1]
    texels = triangles.reshape(-1, 4)
    image = np.zeros_like(texels)
    covered = np.flatnonzero(texels[:, 0])
    for resolved_part in parts:
        part_index = resolved_part.index
        pixels = covered[texels[covered, 0] == part_index + 1]
        if not len(pixels):
            continue
        index = (texels[pixels, 1] * INDEX_BASE + texels[pixels, 2]).astype(np.int64)
        if resolved_part.material.double_sided is False:
            index = scene.mesh.setups[part_index].facing(flat.eye)[index]
        part, old_part = (frame.mesh.parts[part_index] for frame in (scene, before))
        visible, index = _unique(index, len(part.faces))
        corners, old_corners = (pose.positions[part.faces[visible]] for pose in (part, old_part))
        weights = _weights(flat, scene.mesh.normalised(corners), index, rays[pixels])
        position, _ = views[0].project(scene.mesh, _mean(corners, index, weights), size)
        old_position, _ = views[1].project(before.mesh, _mean(old_corners, index, weights), size)
        moved = np.round(position - old_position, _DIGITS) + 0.0  # no -0
        finite = np.isfinite(moved).all(axis=1)
        image[pixels[finite], :2] = moved[finite]
        image[pixels[finite], 3] = 1.0
    return image.reshape(triangles.shape)


def _unique(index: Integers, count: int) -> tuple[Integers, Integers]:
    """Return the result of np.unique for indices below `count`, in a tenth of the time."""
    positions = np.zeros(count, dtype=np.int64)
    positions[index] = 1
    unique = np.flatnonzero(positions)
    positions[unique] = np.arange(len(unique))
    return unique, positions[index]


def _weights(view: View, corners: Float, index: Integers, rays: Float) -> Float:
    """Return the barycentric coordinates (3, N) of the triangles' points at the centres of pixels.

    The ray of a pixel meets a triangle at the weights det(p, b, c), det(p, c, a) and det(p, a, b),
    divided by their sum, for homogeneous image points p of the pixel and a, b, c of the corners
    (Olano and Greer 1997). A driver rounds corners to 1/256 pixel, so that the ray may miss the
    triangle: negative weights become 0.

    corners : (T, 3, 3), corners of triangles in the renderer's space
    index, rays : (N,) triangle of each pixel, and (N, 2) see :func:`motion_vectors`
    """
    a, b, c = np.moveaxis(corners @ view.matrix[:3, _XYW] + view.matrix[3, _XYW], 0, -1).copy()
    x, y = rays.T
    edges = (np.cross(p, q, axis=0) for p, q in ((b, c), (c, a), (a, b)))
    weights = np.array([u[index] * x + v[index] * y + w[index] for u, v, w in edges])
    with np.errstate(divide="ignore", invalid="ignore"):
        weights = np.maximum(weights / weights.sum(axis=0), 0.0)
    weights[:, ~np.isfinite(weights).all(axis=0)] = 1.0  # exactly edge-on
    return np.asarray(weights / weights.sum(axis=0))


def _mean(corners: Float, index: Integers, weights: Float) -> Float:
    corners = np.moveaxis(corners, 1, 0)
    terms = (np.take(corner, index, axis=0) for corner in corners)
    return np.asarray(sum(map(np.multiply, terms, weights[..., None])))
