"""Views: position and projection of a scene's camera in the renderer's space."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from facerender.errors import InputError, check_range
from facerender.material import Material
from facerender.mesh.hints import emit_framing, known_millimetres, unit_of
from facerender.mesh.mesh import Mesh, largest_opacity
from facerender.mesh.part import Part, Region
from facerender.scene.camera import Camera, RegionName, distort
from facerender.scene.scene import Scene
from facerender.values.vectors import IMAGE_SIZES, check_array, direction_to, unit, within_reach

Float = NDArray[np.float64]
Pair = tuple[int, int]  # width and height

FRAMING_MARGIN = 1.04
_AWAY = 4.0  # distance of orthographic cameras from their target, in mesh radii
_HEIGHTS = 1e-5, 1e5  # range of orthographic heights in mesh radii, for float32
_SAME_SHAPE = 0.005  # relative tolerance of the aspect ratio, because sizes are rounded
# Fraction of pixels to ignore: a few stretched triangles must not require finer mip levels.
_UNSEEN = 2e-4
_CELLS = 64  # cells along each side of a part in the image, in which vertices hide others
_BEHIND = 0.03  # distance from which a vertex counts as behind another, in radii of the mesh
_PHASES = np.array([0.61803399, 0.75487766, 0.56984029])  # steps from one phase to the next
_XYW = [0, 1, 3]  # indices of clip x, y and w


@dataclass(frozen=True)
class View:
    """A camera in the renderer's space, where the mesh's bounding sphere is the unit sphere.

    Attributes
    ----------
    position : (3,) float64
    forward : (3,) float64, unit vector of the viewing direction
    matrix : (4, 4) float64, view matrix times projection matrix, for row vectors. Clip y = -1 is
        the top of the image, so that a framebuffer has its rows from the top down. Clip w is the
        depth; for an orthographic camera it is 1
    distortion : lens distortion (see :class:`Camera`), which the matrix leaves out; None for none
    orthographic : whether all rays are parallel
    number : of a shifted image among the images of a pixel's samples, see :attr:`phase`
    """

    position: Float
    forward: Float
    matrix: Float
    distortion: tuple[float, ...] | None = None
    orthographic: bool = False
    number: int = 0

    def __repr__(self) -> str:
        vectors = self.position, self.forward
        start, direction = (", ".join(f"{value:.4g}" for value in vector) for vector in vectors)
        return f"<View from ({start}) along ({direction})>"

    @property
    def eye(self) -> Float:
        """The camera as a homogeneous point (4,): the vector from a surface point p to the camera
        is xyz - w p. It is the position and 1, or -forward and 0 for an orthographic camera."""
        return np.array([*-self.forward, 0.0] if self.orthographic else [*self.position, 1.0])

    def towards(self, positions: Float) -> Float:
        """Return the unit vectors to the camera from positions (..., 3) in the renderer's space."""
        eye = self.eye
        return unit(eye[:3] - eye[3] * positions)

    def pixels(self, size: Pair) -> Float:
        """Return the width and height (2,) in pixels, in an image of the given size, of a square
        with sides of 1 across the view: at depth 1, or of an orthographic camera at every depth.
        Lengths are in the renderer's space."""
        return np.asarray(0.5 * np.multiply(size, self._lens.diagonal()[:2]))

    def pixel(self, mesh: Mesh, size: Pair, depth: Float | float) -> Any:
        """Return the side of a pixel at a depth; both are in mesh units."""
        length = mesh.radius if self.orthographic else depth
        return length / self.pixels(size).min()

    def project(self, mesh: Mesh, points: Float, size: int | Pair) -> tuple[Float, Float]:
        """Project points of mesh space to pixels, with the lens distortion, in float64.

        Parameters
        ----------
        mesh : the scene's mesh, or one with the same bounds
        points : (N, 3), in mesh units
        size : width and height of the image

        Returns
        -------
        pixels : (N, 2), x to the right and y down; the image's top left corner is (0, 0), its first
            pixel's centre (0.5, 0.5). NaN at depths of 0 or less, and where the distortion folds
        depth : (N,), distance from the camera along the viewing direction, in mesh units
        """
        size, points = IMAGE_SIZES.check("size", size), np.asarray(points)
        check_array("points", points, 3)
        clip, depth = self._clip(mesh, points)
        with np.errstate(all="ignore"):
            flat = np.where(depth[:, None] > 0.0, clip[:, :2] / clip[:, 2:], np.nan)
        if self.distortion is not None:
            lens = self._lens
            focal, middle = lens[[0, 1], [0, 1]], lens[:2, 2]
            flat = distort((flat - middle) / focal, self.distortion) * focal + middle
        return (flat + 1.0) * np.divide(size, 2.0), depth * mesh.radius

    def _clip(self, mesh: Mesh, points: Float) -> tuple[Float, Float]:
        """Return clip x, y and w, (N, 3), and the depth (N,) of points (N, 3) of mesh space."""
        rows = np.column_stack([mesh.normalised(points), np.ones(len(points))])
        clip = np.asarray(rows @ self.matrix[:, _XYW])
        if self.orthographic:
            return clip, (rows[:, :3] - self.position) @ self.forward
        return clip, clip[:, 2]

    @property
    def phase(self) -> Float:
        """Phase of the noise of soft shadows, (3,) in [0, 1): shift of the directions, and jitters
        of the radii. The phases of an image's shifted images are spread evenly, so that their noise
        cancels out: Roberts (2018), "The unreasonable effectiveness of quasirandom sequences"."""
        return np.asarray((np.array([0.0, 0.5, 0.5]) + self.number * _PHASES) % 1.0)

    def directions(self, positions: Float) -> Float:
        """Return the directions (N, 3) in mesh space of the rays through positions (N, 2) of the
        undistorted image, whose x and y are from -1 to 1."""
        if self.orthographic:
            return np.broadcast_to(self.forward, (len(positions), 3))
        rays = np.column_stack([positions, np.ones(len(positions))])
        return np.asarray(rays @ np.linalg.inv(self.matrix[:3, _XYW]))

    def shifted(self, pixels: tuple[float, float], size: int | Pair, number: int = 0) -> View:
        """Return the view with its image, of the given size, moved right and down by ``pixels``."""
        move = np.eye(4)
        move[3, :2] = 2.0 * np.asarray(pixels) / size
        return replace(self, matrix=self.matrix @ move, number=number)

    def intrinsics(self, size: int | Pair) -> Float:
        """Return the matrix K, (3, 3), from camera space to pixels of an image of the given size.
        See :meth:`extrinsics` for camera space, and :meth:`project` for pixels. Values are rounded
        to 1e-9 pixels, so that a central principal point is exact. Raises InputError for an
        orthographic camera, whose pixels do not depend on the depth; see :meth:`height`."""
        if self.orthographic:
            raise InputError("an orthographic camera has no intrinsics: use its view_height")
        width, height = np.divide(IMAGE_SIZES.check("size", size), 2.0)
        pixels = np.array([[width, 0.0, width], [0.0, height, height], [0.0, 0.0, 1.0]])
        return np.round(pixels @ self._lens, 9)

    def extrinsics(self, mesh: Mesh) -> Float:
        """Return the matrix [R|t], (3, 4), that maps mesh space to camera space, which has the
        camera at 0, x to the right, y down, z forward, and mesh units.

        mesh : the scene's mesh, or one with the same bounds
        """
        if self.orthographic:
            axes = self.axes
            return np.column_stack([axes, -axes @ mesh.to_mesh_space(self.position)])
        pose = np.asarray(np.linalg.solve(self._lens, self.matrix[:, _XYW].T), np.float64)
        pose[:, 3] = mesh.radius * pose[:, 3] - pose[:, :3] @ mesh.center
        return pose

    @property
    def axes(self) -> Float:
        """The axes (3, 3) of camera space in the renderer's space: x to the right, y down, z
        forward."""
        lens = self._lens
        across = self.matrix[:3, :2].T - lens[:2, 2:] * self.forward
        return np.vstack([across / lens.diagonal()[:2, None], self.forward])

    def height(self, mesh: Mesh) -> float:
        """Return the height of an orthographic camera's view in mesh units."""
        return 2.0 * mesh.radius / float(self._lens[1, 1])

    @property
    def _lens(self) -> Float:
        """Matrix (3, 3) from camera space to clip x, y and depth. Clip x is a multiple of
        camera-space x plus a multiple of the depth; for clip y, y replaces x."""
        x, y, w = self.matrix[:3, 0], self.matrix[:3, 1], self.forward
        if not self.orthographic:
            w = self.matrix[:3, 3]
        lens = np.eye(3)
        for row, axis in enumerate((x, y)):
            lens[row, 2] = axis @ w
            lens[row, row] = np.linalg.norm(axis - lens[row, 2] * w)
        return lens


def mm_per_pixel(scene: Scene, size: Pair) -> float | None:
    """Return the side of a pixel of an orthographic image in mm; None for a perspective image, and
    if the unit of the mesh is unknown."""
    if not scene.camera.orthographic or (unit_length := known_millimetres(scene.mesh)) is None:
        return None
    return float(view_of(scene, size[0] / size[1]).pixel(scene.mesh, size, 1.0) * unit_length)


def scale_of(scene: Scene, size: Pair) -> str:
    """Return the side of a pixel as text for metadata: in mm if the unit is known. In a perspective
    image it is the side at the eyes, or without a face at the mesh's centre."""
    mesh, view, depth, at = scene.mesh, view_of(scene, size[0] / size[1]), 1.0, ""
    if not view.orthographic:
        face = mesh.geometry.framing.face
        at = " at the eyes" if face else " at the centre of the mesh"
        point = mesh.normalised(face.eyes.mean(axis=0)) if face else np.zeros(3)
        depth = float((point - view.position) @ view.forward) * mesh.radius
    unit_length = known_millimetres(mesh)
    length = view.pixel(mesh, size, depth) * (unit_length or 1.0)
    return f"{length:.6g} {'mesh units' if unit_length is None else 'mm'} per pixel{at}"


def to_scale(camera: Camera, mesh: Mesh, mm_per_pixel: float, size: Pair) -> Camera:
    """Return the orthographic camera whose images of a mesh have pixels of the given side in mm.
    Raises InputError if the unit of the mesh is a guess."""
    if (unit_length := known_millimetres(mesh)) is None:
        remedy = unit_of(mesh) or "scale the mesh to mm, and give --millimetres 1"
        raise InputError(f"{mm_per_pixel:g} mm per pixel needs the unit of {mesh.name}: {remedy}")
    height = mm_per_pixel * size[1] / unit_length
    return replace(camera, fov=Camera.fov, zoom=Camera.zoom, view_height=height)


def following(scene: Scene, view: View) -> Scene:
    """Return the scene with its lights that follow the camera where they are for a view."""
    for light in scene.lights:  # any() would call a function for each light of each frame
        if light.follow:
            break
    else:
        return scene
    to_mesh, lights = view.axes * [[1.0], [-1.0], [-1.0]], []  # x right, y up, z to the camera
    for light in scene.lights:
        if light.follow:
            x, y, z = light.direction @ to_mesh
            azimuth, elevation = np.degrees([math.atan2(x, z), math.asin(np.clip(y, -1.0, 1.0))])
            light = replace(light, azimuth=azimuth, elevation=elevation, follow=False)
        lights.append(light)
    return replace(scene, lights=tuple(lights))


def sample_grid(count: int) -> Float:
    """Return evenly distributed sample positions in a pixel, (count, 2) in [-0.5, 0.5]: Hammersley
    points. See Niederreiter (1992), "Random number generation and quasi-Monte Carlo methods",
    section 3.1."""
    index = np.arange(count)
    inverse = np.full(count, 0.5 / count)
    for bit in range(int(count - 1).bit_length()):
        inverse += 0.5 ** (bit + 1) * (index >> bit & 1)
    return np.stack([(index + 0.5) / count, inverse], axis=-1) - 0.5


def view_of(scene: Scene, aspect: float) -> View:
    """Return the view of a scene's camera for images of the given aspect ratio, width / height.

    Raises InputError if the camera is at its target, if the camera or its target is more than 1e6
    mesh radii from the mesh's centre, or if the camera's intrinsics are for another aspect ratio.
    """
    check_range("aspect", aspect, 1e-6, 1e6)
    mesh, camera = scene.mesh, scene.camera
    if camera.size is not None:
        across, down = camera.size
        if not math.isclose(across / down, aspect, rel_tol=_SAME_SHAPE):
            images = f"images of {across} x {down} pixels: give a size with this aspect ratio"
            subject = "intrinsics are" if camera.intrinsics else "size is"
            raise InputError(f"camera {subject} for {images}")
    height = camera.view_height and camera.view_height / mesh.radius
    if height and not _HEIGHTS[0] <= height <= _HEIGHTS[1]:
        limits = "{:.3g} to {:.3g}".format(*np.multiply(_HEIGHTS, mesh.radius))
        raise InputError(f"camera view_height = {camera.view_height:g}: give {limits} mesh units")
    if camera.extrinsics is not None:
        return _placed(mesh, camera, aspect, height)
    if camera.frame != "all" and None in (camera.position, camera.target):
        emit_framing(mesh, camera.frame)
    target = target_of(mesh, camera)
    if camera.position is None:
        framed = region_of(mesh, camera.frame) or mesh
        if camera.orthographic:
            # Outside of the mesh, and the same for all poses, so that depths do not jump.
            distance = _AWAY + math.sqrt(target @ target)
            height = height or _framing_height(framed.profile, aspect) / camera.zoom
        else:
            angles = camera.elevation, camera.fov, aspect
            make = lambda: _framing_distance(framed.profile, *angles)  # noqa: E731
            distance = mesh.geometry.derived.of("distance", (camera.frame, *angles), make)
            distance /= camera.zoom
        eye = target + distance * direction_to(camera.azimuth, camera.elevation)
    else:
        eye = within_reach(f"camera position {camera.position}", mesh.normalised(camera.position))
    gaze = target - eye
    distance = math.sqrt(gaze @ gaze)
    if distance < 1e-6:
        raise InputError(f"camera position {camera.position} is at its target; move one of them")
    forward = gaze / distance
    up = np.array([0.0, 1.0, 0.0])
    if abs(forward[1]) > 0.9999:  # from above, the image's top shows the back of the head
        up = -direction_to(camera.azimuth, 0.0) * np.sign(-forward[1])
    elif camera.position is not None and camera.azimuth:
        pair = f"camera azimuth = {camera.azimuth:g} and position exclude each other"
        raise InputError(f"{pair}, unless the camera looks straight up or down: leave one out")
    lens = _projection(camera.fov, height, aspect, -float(eye @ forward), mesh.space.reach)
    matrix = _look(eye, target, up) @ lens
    return View(eye, forward, matrix, orthographic=camera.orthographic)


def shifted(scene: Scene, x: float, y: float, size: int | Pair) -> Scene:
    """Return the scene with its image, of the given size, moved x pixels right and y pixels down.

    Raises InputError for an invalid size, for x or y outside [-1e6, 1e6], and as :func:`view_of`.
    """
    size = width, height = IMAGE_SIZES.check("size", size)
    check_range("x", x, -1e6, 1e6)
    check_range("y", y, -1e6, 1e6)
    view = view_of(scene, width / height).shifted((x, y), size)
    pose = view.extrinsics(scene.mesh)
    if view.orthographic:
        view_height = view.height(scene.mesh)
        pose[:2, 3] += np.array([x, y]) * view_height / height
        return replace(scene, camera=Camera(extrinsics=pose, view_height=view_height))
    lens, distortion = view.intrinsics(size), scene.camera.distortion
    camera = Camera(extrinsics=pose, intrinsics=lens, size=size, distortion=distortion)
    return replace(scene, camera=camera)


def region_of(mesh: Mesh, frame: RegionName) -> Region | None:
    """Return the region of a mesh that a camera frames; None for the whole mesh."""
    return None if frame == "all" else mesh.regions[frame]


def target_of(mesh: Mesh, camera: Camera) -> Float:
    """Return the target (3,) of a camera without extrinsics, in the renderer's space."""
    if camera.target is not None:
        return within_reach(f"camera target {camera.target}", mesh.normalised(camera.target))
    region = region_of(mesh, camera.frame)
    return np.zeros(3) if region is None else region.center


def _placed(mesh: Mesh, camera: Camera, aspect: float, height: float | None) -> View:
    """Return the view of a camera with extrinsics and, optionally, intrinsics."""
    pose = np.array(camera.extrinsics)
    left, _, right = np.linalg.svd(pose[:, :3])
    turn = left @ right  # the nearest rotation, because R may be rounded
    eye = within_reach("position in camera extrinsics", mesh.normalised(-turn.T @ pose[:, 3]))
    forward = turn[2]
    lens = _projection(camera.fov, height, aspect, -float(eye @ forward), mesh.space.reach)
    if camera.intrinsics is not None and camera.size is not None:
        width, height = camera.size
        k = np.array(camera.intrinsics)
        lens[0, 0], lens[1, 1] = 2.0 * k[0, 0] / width, -2.0 * k[1, 1] / height
        lens[2, :2] = 1.0 - 2.0 * k[:2, 2] / camera.size
    matrix = _look(eye, eye + forward, -turn[1]) @ lens
    return View(eye, forward, matrix, camera.distortion, camera.orthographic)


def _look(position: Float, target: Float, up: Float) -> Float:
    """Return the matrix from the renderer's space to camera space, for row vectors."""
    forward = target - position
    forward /= math.sqrt(forward @ forward)
    right = _cross(forward, up)
    right /= math.sqrt(right @ right)
    look = np.eye(4)
    look[:3, :3] = np.array([right, _cross(right, forward), -forward]).T
    look[3, :3] = -position @ look[:3, :3]
    return look


def _cross(a: Float, b: Float) -> Float:
    """Return the cross product of two vectors (3,); np.cross takes 80 function calls."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def _projection(
    fov: float, height: float | None, aspect: float, depth: float, reach: float
) -> Float:
    """Return the matrix from camera space to clip space, with y down, for row vectors. The sphere
    around all vertices, whose centre is at ``depth`` and whose radius is ``reach``, lies between
    the near plane and the far plane. Source: OpenGL 2.1, gluPerspective and glOrtho.

    height : of an orthographic camera's view in the renderer's space; None for a perspective camera
    """
    far = max(depth + reach, 0.02)
    near = max(depth - reach, far * 1e-3)
    lens = np.zeros((4, 4))
    if height is not None:
        lens[0, 0], lens[1, 1] = 2.0 / (height * aspect), -2.0 / height
        lens[2, 2], lens[3, 2:] = -2.0 / (far - near), ((far + near) / (near - far), 1.0)
        return lens
    tangent = math.tan(math.radians(fov) / 2.0)
    lens[0, 0], lens[1, 1] = 1.0 / (tangent * aspect), -1.0 / tangent
    lens[2, 2:] = (far + near) / (near - far), -1.0
    lens[3, 2] = 2.0 * far * near / (near - far)
    return lens


def hidden(scene: Scene, size: tuple[int, ...], threshold: float | None) -> str:
    """Return the reason why an image of the given size shows nothing of the mesh, and a remedy. For
    ``threshold`` see :func:`facerender.drawing.frame.check_images`."""
    mesh, view = scene.mesh, view_of(scene, size[0] / size[1])
    positions = np.concatenate([part.positions for part in mesh.parts])
    pixels, depth = view.project(mesh, positions, (size[0], size[1]))
    if not (depth > 0.0).any():
        return "all of it lies behind the camera; turn the camera, or move it back"
    pixels = pixels[np.isfinite(pixels).all(axis=-1)]
    if not len(pixels):
        return "all of it lies beyond the reach of the lens distortion; turn the camera"
    x, y = (2.0 * pixels / size - 1.0).T
    extent = float(np.ptp(pixels, axis=0).max())
    if (inside := (np.abs(x) <= 1.0) & (np.abs(y) <= 1.0)).any():
        if extent < 2.0:
            return f"it is {extent:.2g} pixels large; move the camera nearer, or zoom in"
        pairs = zip(mesh.parts, mesh.materials, strict=True)
        causes = [_not_drawn(mesh, *pair, view, threshold) for pair in pairs]
        if all(causes):
            return "; ".join(dict.fromkeys(causes))
        return (
            f"{inside.sum()} of its vertices are in the frame, but no triangle covers a "
            "pixel; frame more of the mesh, or give more pixels"
        )
    outside = x.max() < -1.0, x.min() > 1.0, y.max() < -1.0, y.min() > 1.0
    ways = compress(("left of", "right of", "above", "below"), outside)
    return f"it lies {' and '.join(ways) or 'around'} the frame; set camera target, or position"


def _not_drawn(mesh: Mesh, part: Part, material: Material, view: View, cutoff: float | None) -> str:
    """Return why no fragment of a part is drawn, and a remedy; "" if its triangles are drawn."""
    name = part.name or "it"
    if material.double_sided is False:
        a, b, c = np.moveaxis(mesh.normalised(part.positions)[part.faces], 1, 0)
        if not (np.einsum("ij,ij->i", np.cross(b - a, c - a), view.towards(a)) > 0.0).any():
            return f"{name} shows only back faces; give --double-sided, or turn the camera"
    if cutoff is not None and material.thin:
        return f"{name} transmits light, and data images omit such parts; draw the image itself"
    opacity = largest_opacity(part, material)
    limits = {"blend": cutoff or 1e-9, "mask": material.alpha_cutoff, "opaque": 0.0}
    if opacity >= limits[material.alpha]:
        return ""
    option = "a lower --alpha-threshold" if cutoff and material.alpha == "blend" else ""
    option = option or f"--part '{part.name or '*'},alpha=opaque'"
    return f"the opacity of {name} is at most {opacity:.2g}; give {option}"


def levels_to_spare(
    mesh: Mesh, part: Part, uv: Float, texels: Pair, view: View, size: Pair, anisotropy: float = 1.0
) -> int:
    """Return how many of a map's finest mip levels are not read for an image of the given view.

    A triangle reads the level log2(t), where t is the number of texels along the longer axis of a
    pixel's footprint (OpenGL 3.3, section 3.8.11). Anisotropic filtering divides t by the
    anisotropy (EXT_texture_filter_anisotropic), which is 1 without it.

    uv, texels : texture coordinates of the part; width and height of the map
    """
    clip, depth = view._clip(mesh, part.positions)
    w = clip[:, 2]
    in_front = w[part.faces] > 1e-6
    faces = part.faces[in_front.all(axis=1)]
    if in_front.any(axis=1).sum() > len(faces):
        return 0  # a triangle reaches the camera
    half = np.divide(size, 2.0)
    pixels = clip[:, :2] / np.maximum(w, 1e-6)[:, None] * half
    corners, coordinates = pixels[faces], (uv * texels)[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    extent = np.clip(np.minimum(high, half) - np.maximum(low, -half), 0.0, None)
    (x1, y1), (x2, y2) = np.moveaxis(corners[:, 1:] - corners[:, :1], 0, -1)[..., None]
    double = (x1 * y2 - y1 * x2)[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Estimates the visible fraction of a triangle by the visible fraction of its bounding box.
        area = np.abs(double) * np.nan_to_num(np.prod(extent / (high - low), axis=1))
        first, second = np.moveaxis(coordinates[:, 1:] - coordinates[:, :1], 1, 0)
        by_x = (first * y2 - second * y1) / double[:, None]
        by_y = (second * x1 - first * x2) / double[:, None]
        read = np.sqrt(np.maximum((by_x**2).sum(axis=1), (by_y**2).sum(axis=1))) / anisotropy
    # Triangles that the part itself hides, such as the inside of a closed mouth, do not count.
    visible = (area > 0.0) & np.isfinite(read) & ~_hidden(pixels / half, depth)[faces].all(axis=1)
    if not visible.any():
        return 0
    area, read = area[visible], read[visible]
    order = np.argsort(read)
    finest = read[order][np.searchsorted(np.cumsum(area[order]), _UNSEEN * area.sum())]
    limit = min(texels).bit_length() - 2  # the finest level that is left has at least 2 x 2 texels
    return max(min(math.floor(math.log2(max(finest, 1.0))), limit), 0)


def _hidden(positions: Float, depth: Float) -> NDArray[np.bool_]:
    """Return which vertices are behind the nearest vertices of their cell and of all eight cells
    around it, in a grid over their part of the image. A cell without vertices hides nothing.

    positions, depth : x and y from -1 to 1 in the image, and distance from the camera, per vertex
    """
    inside = np.clip(positions, -1.0, 1.0)
    low, high = inside.min(axis=0), inside.max(axis=0)
    cells = np.clip((positions - low) / np.maximum(high - low, 1e-9) * _CELLS, -1.0, _CELLS)
    indices = np.floor(cells).astype(np.int64) + 1
    nearest = np.full((_CELLS + 2, _CELLS + 2), np.inf)
    np.minimum.at(nearest, tuple(indices.T), np.where(depth > 0.0, depth, np.inf))
    around = np.pad(nearest[1:-1, 1:-1], 2, constant_values=np.inf)
    farthest = sliding_window_view(around, (3, 3)).max(axis=(2, 3))
    return np.asarray(depth > farthest[tuple(indices.T)] + _BEHIND)


def _framing_height(profile: Float, aspect: float) -> float:
    """Return the height of an orthographic view, with FRAMING_MARGIN, into which a profile fits at
    every azimuth and elevation: the views of a mesh have one scale."""
    return 2.0 * FRAMING_MARGIN * float(np.hypot(*profile.T).max()) / min(aspect, 1.0)


def _framing_distance(profile: Float, elevation: float, fov: float, aspect: float) -> float:
    """Return the camera distance, with FRAMING_MARGIN, at which a profile fits into the view at
    every azimuth."""
    r, y = profile.T
    sine, cosine = math.sin(math.radians(elevation)), math.cos(math.radians(elevation))
    vertical = math.tan(math.radians(fov) / 2.0)
    horizontal = vertical * aspect
    # Relative to the orbiting camera, a vertex at height y and distance r from the axis moves on a
    # circle. At these camera distances, the circle touches the edges of the view.
    top = y * (sine + cosine / vertical) + r * abs(cosine - sine / vertical)
    bottom = y * (sine - cosine / vertical) + r * abs(cosine + sine / vertical)
    side = y * sine + r * math.hypot(1.0 / horizontal, cosine)
    return FRAMING_MARGIN * float(max(top.max(), bottom.max(), side.max()))
