"""Hints: probable mistakes in a mesh or scene. Each function returns one line with the remedy, or
None if nothing indicates a mistake. A wrong hint costs more than a missing one, so each
function requires clear evidence. Maps that are not decoded yet are examined only if ``decode`` is
true: the functions then decode them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, note, warn
from facerender.material import Material
from facerender.mesh.mesh import Mesh, coordinates, largest_opacity
from facerender.mesh.part import Part
from facerender.mesh.repair import double_areas
from facerender.texture.texture import Texture
from facerender.values.vectors import MILLIMETRES, Array, Float, axis_of, upright_of

_Pieces = Sequence[tuple[Part, Float]]

# Distance between the eyes in mm: mean of adults, and range from small children to the largest
# adults. Source: Dodgson (2004), "Variation and extrema of human interpupillary distance".
EYE_DISTANCE, _EYE_DISTANCES = 63.0, (40.0, 80.0)
_HEAD = 230.0  # height of a head in mm, from chin to crown
_UNITS = {1.0: "mm", 10.0: "cm", 25.4: "inches", 1000.0: "m"}
_NEAR = 1.5  # largest ratio of an estimated unit and the unit that is meant

_MAP = 128  # largest side of the map's mip level that is compared with the mesh
_NORMAL_MAP = 256  # largest side of the normal map's mip level that is examined
_FACES, _VERTICES = 4096, 8192  # maximum numbers of examined faces and vertices
_APART = 0.02  # minimum distance between texture coordinates on the two sides of a seam


def gloss_of(material: Material) -> tuple[Any, ...]:
    """Return the values of a highlight, for :attr:`Geometry.gloss`."""
    return material.ks, material.f0, material.m, material.roughness_map


def emit_framing(mesh: Mesh, frame: str) -> None:
    """Emit the hints on a face that a camera frames; see :func:`emit`."""
    emit(mesh, guessed, guessed(mesh, frame))
    emit(mesh, turned, turned(mesh))


def emit_all(mesh: Mesh) -> None:
    """Emit the hints on the materials of a mesh, without decoding maps; see :func:`emit`."""
    derived, gloss, materials = mesh.geometry.derived, mesh.geometry.gloss, mesh.materials

    def of_highlights() -> dict[Callable[..., str | None], str | None]:
        is_of_file = gloss and all(gloss_of(materials[i]) == gloss[i] for i in mesh.skin)
        return {no_ks: no_ks(mesh), faint: faint(mesh) if is_of_file else None}

    # The maps are compared apart from the materials, because m changes more often.
    maps = [(m.albedo_map, m.normal_map, m.alpha) for m in materials]
    hints = derived.of("map hints", maps, lambda: {h: h(mesh) for h in (upside_down, green_down)})
    for hint, line in {**hints, **derived.of("hints", materials, of_highlights)}.items():
        emit(mesh, hint, line)


def emit(mesh: Mesh, hint: Callable[..., str | None], line: str | None) -> None:
    """Emit a hint: as a warning once per mesh, and for each image that records its warnings."""
    if line is not None:
        emitted = mesh.geometry.derived.setdefault("emitted", set())
        (note if hint in emitted else warn)(line)
        emitted.add(hint)


def of_mesh(mesh: Mesh) -> list[str]:
    """Return all hints on a mesh. Decodes the maps."""
    others = no_ks(mesh), faint(mesh, True), turned(mesh), wrong_unit(mesh)
    return [hint for hint in (upside_down(mesh, True), green_down(mesh, True), *others) if hint]


def upside_down(mesh: Mesh, decode: bool = False) -> str | None:
    """Return a hint if the texture coordinates are probably upside down.

    Three properties of a map are compared between the coordinates and the same coordinates with
    reversed v. The detail of the map correlates with the curvature of the mesh, because eyes, nose
    and lips have both. The two sides of a seam have equal colours. The mesh covers little of the
    map's uniform background. The first two can give the hint; all three can refute it."""
    # Opaque parts with texture coordinates, keyed by albedo map or, without one, by normal map
    pieces_by_texture: dict[Texture, list[tuple[Part, Float]]] = {}
    for part, material in zip(mesh.parts, mesh.materials, strict=True):
        name = "albedo_map" if material.albedo_map else "normal_map"
        texture, uv = getattr(material, name), coordinates(part, material, name)
        if texture and uv is not None and material.alpha == "opaque":
            pieces_by_texture.setdefault(texture, []).append((part, uv))
    best: Sequence[float] = (0.0, 0.0)
    for texture, pieces in pieces_by_texture.items():
        image = _preview(texture, _MAP, decode)
        few = sum(len(part.faces) for part, _ in pieces) < 200
        if few or image is None or min(image.shape[:2]) < 32:
            continue
        for agreement in _agreements(pieces, image):
            if agreement[0] > agreement[1]:
                return None
            best = max(best, agreement, key=lambda pair: pair[1] - pair[0])
    if not any(best):
        return None
    scores = f"agreement with the map: {best[0]:.2f}, with reversed v: {best[1]:.2f}"
    problem = f"the texture coordinates of {mesh.name} are probably upside down ({scores})"
    return f"{problem}: give --flip-v (flip_v=True), or leave it out if you gave it"


def _agreements(pieces: _Pieces, image: NDArray[np.uint8]) -> Iterator[Sequence[float]]:
    """Yield clearly different agreements of mesh and map: as given, and with reversed v."""
    faces = _sample(pieces)
    original, reverse = detail = _detail(faces, image)
    if max(detail) >= 0.3 and abs(original - reverse) >= 0.25:
        yield detail
    original, reverse = colours = _seam_colours(pieces, image)
    if max(colours) >= 0.6 and abs(original - reverse) >= 0.4:
        yield colours
    original, reverse = _background(faces, image)
    if reverse - original >= 0.15:  # the reverse proves little: dark clothes look like background
        yield 1.0 - original, 1.0 - reverse


def _sample(pieces: _Pieces) -> list[Float]:
    """Return the texture coordinates (F, 2) of the centres of some faces, the areas of the faces,
    and their curvature: difference of the vertex normals / size of the face."""
    step = -(-sum(len(part.faces) for part, _ in pieces) // _FACES) or 1
    samples = []
    for part, uv in pieces:
        faces = part.faces[::step]
        area = double_areas(part.positions[faces])
        faces, area = faces[area > 0.0], area[area > 0.0]
        a, b, c = (part.normals[corner] for corner in faces.T)
        turns = sum(np.sqrt(((i - j) ** 2).sum(axis=1)) for i, j in ((a, b), (b, c), (c, a)))
        samples.append((uv[faces].sum(axis=1) / 3.0, area, turns / np.sqrt(area)))
    return [*map(np.concatenate, zip(*samples, strict=True))]


def _detail(faces: Sequence[Float], image: NDArray[np.uint8]) -> Sequence[float]:
    """Return the rank correlation of the map's detail and the curvature, also with reversed v."""
    centers, _, curvature = faces
    if not len(curvature) or np.ptp(curvature) == 0.0:
        return 0.0, 0.0
    detail, ranks = _contrast(image), _ranks(curvature)
    for axis in (0, 1):
        detail = detail + np.roll(detail, 1, axis) + np.roll(detail, -1, axis)
    return [_correlation(ranks, _ranks(_texels(detail, uv))) for uv in _both(centers)]


def _seam_colours(pieces: _Pieces, image: NDArray[np.uint8]) -> tuple[float, float]:
    """Return the correlation of the colours on the two sides of seams, and the same with reversed
    v. Both are 0 if the larger correlation has no smaller difference of colour."""
    left, right = np.concatenate([_seams(part.positions, uv) for part, uv in pieces], axis=1)
    if len(left) < 100:
        return 0.0, 0.0
    results = []
    for sides in zip(_both(left), _both(right), strict=True):
        a, b = (_texels(image, uv).astype(np.float64) for uv in sides)
        middle = (a + b).mean(axis=0) / 2.0
        results.append((_correlation(a - middle, b - middle), float(np.abs(a - b).mean())))
    (original, jump), (reverse, reverse_jump) = results
    smaller, larger = (reverse_jump, jump) if reverse > original else (jump, reverse_jump)
    return (original, reverse) if 1.3 * smaller < larger else (0.0, 0.0)


def _background(faces: Sequence[Float], image: NDArray[np.uint8]) -> list[float]:
    """Return the fraction of the surface that lies on the map's background, and the same with
    reversed v. The background is the most frequent colour where it is uniform."""
    centers, areas, _ = faces
    keys = (image >> 3).astype(np.int64) @ (1024, 32, 1)
    colour = np.median(image[keys == np.bincount(keys.ravel()).argmax()], axis=0)
    uniform = (np.abs(image - colour).max(axis=-1) <= 6.0) & (_contrast(image) <= 12.0)
    shares = areas / (areas.sum() or 1.0)
    return [float(shares @ _texels(uniform, uv)) for uv in _both(centers)]


def _seams(positions: Float, uv: Float) -> Float:
    """Return the texture coordinates (2, S, 2) of vertices with equal positions."""
    hashes = positions @ (0.7548776662466927, 0.5698402909980532, 0.4301597090019468)
    order = np.arange(len(hashes))
    if len(order) > _VERTICES:  # a choice by position keeps both sides of a seam
        scaled = hashes * (1e4 / (np.ptp(hashes) or 1.0))
        order = np.flatnonzero(scaled % 1.0 < _VERTICES / len(order))
    order = order[np.argsort(hashes[order], kind="stable")]
    pairs = np.flatnonzero(hashes[order[1:]] == hashes[order[:-1]])
    left, right = uv[order[pairs]], uv[order[pairs + 1]]
    return np.stack([left, right])[:, np.abs(left - right).max(axis=1, initial=0.0) > _APART]


def _both(uv: Float) -> tuple[Float, Float]:
    """Return texture coordinates, and the same with reversed v."""
    return uv, uv * (1.0, -1.0) + (0.0, 1.0)


def _texels(image: Array, uv: Float) -> Array:
    """Return the texels of an image, with row 0 at the bottom, at texture coordinates."""
    height, width = image.shape[:2]
    columns, rows = ((uv % 1.0) * (width, height)).astype(np.int64).T
    return np.asarray(image[rows.clip(0, height - 1), columns.clip(0, width - 1)])


def _contrast(image: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return the summed differences between each texel and its neighbours. The image repeats."""
    texels = image.astype(np.int32)
    total = np.zeros(image.shape[:2], dtype=np.int32)
    for axis in (0, 1):
        steps = np.abs(texels - np.roll(texels, 1, axis)) @ np.ones(3, dtype=np.int32)
        total += steps + np.roll(steps, -1, axis)
    return total


def _ranks(values: Array) -> Float:
    """Return the ranks of values, with mean 0. Equal values have equal ranks."""
    _, indices, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - 0.5 * counts - 0.5 * len(values))[indices])


def _correlation(a: Float, b: Float) -> float:
    """Return the correlation of values with mean 0, or 0 for constant values."""
    norm = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / norm if norm > 0.0 else 0.0


def green_down(mesh: Mesh, decode: bool = False) -> str | None:
    """Return a hint if the green of a normal map probably points down.

    The slopes p and q of a height field satisfy dp/dy = dq/dx. If green points down, q is negative,
    and the two derivatives have opposite signs."""
    for texture in dict.fromkeys(m.normal_map for m in mesh.materials if m.normal_map):
        image = _preview(texture, _NORMAL_MAP, decode)
        if image is None or min(image.shape[:2]) < 32:
            continue
        normals = image.astype(np.float32) - np.float32(127.5)
        p, q = np.moveaxis(normals[..., :2] / normals[..., 2:].clip(20.0), -1, 0)
        across, along = p[2:, 1:-1] - p[:-2, 1:-1], q[1:-1, 2:] - q[1:-1, :-2]
        # Differences of less than three 8-bit levels may be noise.
        clear = (np.abs(across) > 0.02) & (np.abs(along) > 0.02)
        opposite = float((across[clear] * along[clear] < 0.0).mean()) if clear.any() else 0.0
        if clear.mean() >= 0.03 and opposite >= 0.65:
            share = f"for {opposite:.0%} of its relief"
            remedy = "give --normal-map-y down (normal_map_y='down')"
            return f"the green of {texture.name} probably points down ({share}): {remedy}"
    return None


def _preview(texture: Texture, side: int, decode: bool) -> NDArray[np.uint8] | None:
    try:
        return texture.preview(side, decode)
    except InputError:  # a damaged map: drawing it reports the error
        return None


def faint(mesh: Mesh, decode: bool = False) -> str | None:
    """Return a hint if at least half of the skin has a specular weight above 0, but no visible
    highlight. The peak of a highlight is proportional to ks f0 / m^2."""
    skin = Material()
    threshold = 0.1 * skin.ks * skin.f0 / skin.m**2  # a highlight below it is invisible
    pairs = [(mesh.parts[i], mat) for i in mesh.skin if not (mat := mesh.materials[i]).unlit]
    slopes = [(material, _least_slope(part, material, decode)) for part, material in pairs]
    dull = [i for i, (mat, m) in enumerate(slopes) if 0.0 < mat.ks * mat.f0 < threshold * m**2]
    if not dull:
        return None
    areas = [float(double_areas(part.positions[part.faces]).sum()) for part, _ in pairs]
    if sum(areas[i] for i in dull) < 0.5 * sum(areas):
        return None
    _, ks, m = max((areas[i], slopes[i][0].ks, slopes[i][1]) for i in dull)
    remedies = [f"--ks {skin.ks:g}"] * (ks < 0.5) + [f"--m {skin.m:g}"] * (m > 2.0 * skin.m)
    remedy = f"give {' '.join(remedies or [f'--f0 {skin.f0:g}'])} for skin"
    return f"{mesh.name} has no visible highlight with ks {ks:.2g} and m {m:.2g}: {remedy}"


def no_ks(mesh: Mesh) -> str | None:
    """Return a hint if a part whose file has Ks 0 is drawn with highlights nevertheless."""
    pairs = zip(mesh.geometry.parts, mesh.materials, strict=True)
    if not any(p.ks_ignored and not p.preset and m.ks == Material.ks for p, m in pairs):
        return None
    cause = f"{mesh.name} has Ks 0 in its MTL, which many exporters write by default"
    return f"{cause}: drawn with the highlights of skin; pass --ks 0 for none"


def _least_slope(part: Part, material: Material, decode: bool) -> float:
    """Return the smallest m of a part over both lobes; 0 if the roughness map is not decoded."""
    m = material.m
    if material.roughness_map and coordinates(part, material, "roughness_map") is not None:
        packed = material.property_map
        image = _preview(packed or material.roughness_map, _MAP, decode)
        if image is None:
            return 0.0
        m = (material.roughness_factor * image[..., 1 if packed else 0].min() / 255.0) ** 2
    return float(material.with_second(m, m)[0])


def too_clear(mesh: Mesh, threshold: float) -> str | None:
    """Return a hint if data images lack a part, because its opacity is below a threshold
    everywhere. Decodes the opacity maps of blended parts."""
    pairs = zip(mesh.parts, mesh.materials, strict=True)
    blended = [(p, m) for p, m in pairs if m.alpha == "blend" and not m.transmission]
    clear = [part for part, material in blended if largest_opacity(part, material) < threshold]
    if not clear:
        return None
    problem = f"parts of {mesh.name} whose opacity is below {threshold:g} everywhere"
    remedy = "give a lower --alpha-threshold to include them"
    listing = clipped(", ".join(part.name or "the part without a name" for part in clear), 200)
    return f"data images and landmarks omit {problem}: {listing}; {remedy}"


def millimetres_of(mesh: Mesh) -> tuple[float, bool] | None:
    """Return the probable length of a mesh unit in mm, and whether it is certain: a usual unit with
    which the eyes have a usual distance. Without a face, the head is assumed to be 230 mm high, and
    the length is a guess. None for a length that no mesh can have."""
    framing = mesh.geometry.framing
    if (face := framing.face) is not None:
        length = EYE_DISTANCE / face.eye_distance
    else:
        head = framing.regions["head"]
        height = 2.0 * head.height * mesh.radius if head else 0.0
        length = _HEAD / height if height > 0.0 else 0.0
    if length not in MILLIMETRES:
        return None
    usual = min(_UNITS, key=lambda unit: abs(np.log(length / unit)))
    if 1.0 / _NEAR < length / usual < _NEAR:
        return usual, face is not None
    return float(f"{length:.2g}"), False


def known_millimetres(mesh: Mesh) -> float | None:
    """Return the length of a mesh unit in mm, from the mesh or its eyes; None for a guess."""
    if mesh.millimetres is None and (probable := millimetres_of(mesh)) and probable[1]:
        return probable[0]
    return mesh.millimetres


def unit_of(mesh: Mesh) -> str | None:
    """Return the option that sets the length of a mesh unit, with the reason; None if unknown."""
    if (result := millimetres_of(mesh)) is None:
        return None
    length, certain = result
    option = f"--millimetres {length:g}" + (f" ({_UNITS[length]})" if length in _UNITS else "")
    if certain:
        return f"give {option} for an eye distance of about {EYE_DISTANCE:g} mm"
    return f"{option} is a guess: measure the mesh"


def wrong_unit(mesh: Mesh) -> str | None:
    """Return a hint if the mesh has a unit with which its eyes cannot be the eyes of a person."""
    face, millimetres = mesh.geometry.framing.face, mesh.millimetres
    if face is None or millimetres is None:
        return None
    distance = face.eye_distance * millimetres
    if _EYE_DISTANCES[0] / _NEAR <= distance <= _EYE_DISTANCES[1] * _NEAR:
        return None
    size = f"{distance:.3g} mm apart if its unit is {millimetres:g} mm"
    return f"the eyes of {mesh.name} are {size}: {unit_of(mesh) or 'scale the mesh to mm'}"


def turned(mesh: Mesh) -> str | None:
    """Return a hint if the face of a mesh does not look along +z with y up."""
    geometry = mesh.geometry
    if (face := geometry.framing.face) is None:
        return None
    up, front = axis_of(face.up), axis_of(face.front)
    if (up, front) == ("y", "z"):
        return None
    option = "--up auto"
    if geometry.rotation is None:
        _, angle, _ = upright_of(face.axes)
        options = [f"--up {up}"] * (up != "y") + [f"--rotate 0,{angle:g},0"] * (angle != 0.0)
        option = f"{' '.join(options)}, or --up auto"
    pose = f"looks along {front}, and the top of the head is along {up}"
    return f"the face of {mesh.name} {pose}: give {option} (up='auto')"


def guessed(mesh: Mesh, frame: str) -> str | None:
    """Return a hint if a camera frames a region of a face that was not found on the surface."""
    framing = mesh.geometry.framing
    if framing.face is not None or mesh.regions[frame] is None:
        return None
    if not framing.source:
        return f"no face was found on {mesh.name}: frame {frame} shows the whole mesh"
    cause = f"its head is a guess from {framing.source}"
    return f"no face was found on {mesh.name}, and {cause}: look at the image, or give --target"
