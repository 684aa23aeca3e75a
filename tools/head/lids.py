"""Open eyelids: a hole is cut into the closed head around each eye, and rings of vertices fill it.

The rings run around the opening. From the border of the hole inward they form the skin of the lids,
the edge of the lids, their margin, which touches the eyeball, and their back, which lies on the
eyeball. At the corners, where the opening is wider than the eyeball, the margin is the floor of the
corner, with the caruncle. Lengths are in cm; x, y, z are relative to the centre of the eyeball,
with x away from the nose.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from .eyes import Eye, eye_distance, eye_size, front_height, ring_faces
from .fields import Floats, bell, ramp
from .shape import head_distance, lidless_distance
from .surface import Faces, Mesh, vertex_normals

# Edges of the lids in the front view, from the inner to the outer corner.
UPPER_EDGE = (
    (-1.63, -0.20),
    (-1.47, -0.11),
    (-1.22, 0.06),
    (-0.92, 0.235),
    (-0.55, 0.36),
    (-0.12, 0.41),
    (0.32, 0.385),
    (0.72, 0.29),
    (1.03, 0.14),
    (1.30, -0.04),
)
LOWER_EDGE = (
    (-1.63, -0.20),
    (-1.45, -0.26),
    (-1.15, -0.34),
    (-0.75, -0.475),
    (-0.30, -0.58),
    (0.12, -0.605),
    (0.52, -0.56),
    (0.87, -0.43),
    (1.12, -0.245),
    (1.30, -0.04),
)
UPPER_STEPS, LOWER_STEPS = 36, 32  # vertices of each ring along a lid
RIGHT_LID_HEIGHT = 0.97  # height of the right eye's opening, relative to the left eye's

HOLE_CENTRE = (0.02, -0.10)
HOLE_HALF = (2.15, 1.28)  # half axes of the outermost ring
HOLE_MARGIN = 0.05  # the hole is larger than this ring

LID_THICKNESS = 0.17
SHELL_ROUNDING = 0.12  # height difference within which the lid's shape over the cornea blends
# The lids follow the eyeball up to a distance from its axis, then a line: (distance, slope).
INNER_LINE, OUTER_LINE = (1.10, 0.05), (1.15, -1.40)

# Places of the lids' rings, from the edge (0) to the border of the hole (1).
LID_RINGS = (0.06, 0.14, 0.23, 0.31, 0.365, 0.405, 0.45, 0.51, 0.59, 0.70, 0.83)
CREASE = 0.40  # place of the crease of the upper lid
EDGE_ROUNDING = 0.045
EDGE_STEPS, MARGIN_STEPS = 3, 3
WIDEST = 1.12  # largest distance from the axis at which a margin touches the eyeball
LOWER_SHELF = 0.055  # width of the lower margin in the front view
GAP = 0.008  # between margin and eyeball
BACK = ((9.0, 0.03), (26.0, 0.06))  # polar angle behind the margin, degrees; gap
CARUNCLE = (-1.33, -0.18, 0.11, 0.12)  # x, y, radius, height

# Closed lids: the upper lid overlaps the lower one, and its skin lies above that of the open lid.
# Openings above which it moves the whole way down, and the whole way forward.
CLOSED_OVERLAP, CLOSED_LIFT = 0.04, 0.105
CLOSED_CORNER = (0.20, 0.50)
CLOSED_FALLOFF = 2.0  # of the shift, from the edge to the border of the hole
CLOSED_ON_EYE = (0.90, 0.30)  # places between which the upper lid comes to lie on the eyeball
# Depths behind the skin of the rounded edge and of the first margin rings; fractions of the way to
# these places that the margin rings move.
CLOSED_DEPTHS = (0.016, 0.036, 0.018)
CLOSED_PART = (1.0, 0.12)

HIGHEST, TRACING_STEPS = 4.5, 100  # start and steps of the search for the face from the front

TUCKED_REACH = 0.84  # fraction of the way to the middle of the opening that its texels fill
TUCKED_SQUEEZE = 0.55  # width of the targets of these texels, relative to the opening


@dataclass(frozen=True)
class Tucked:
    """Vertices in the opening, whose texture coordinates are means of other vertices' ones."""

    vertices: NDArray[np.int64]
    anchors: NDArray[np.int64]  # (N, 5)
    weights: Floats  # (N, 5)


@dataclass(frozen=True)
class Opening:
    """The rings of an eye, local, of shape (rings, points, 3), and the rows of special rings."""

    eye: Eye
    rings: Floats
    edge: int  # last ring of the skin, next to the edge of the lids
    margin: int  # ring that touches the eyeball

    @property
    def upper(self) -> NDArray[np.int64]:
        """The columns of the upper lid, from the inner to the outer corner."""
        return np.arange(UPPER_STEPS + 1)

    @property
    def lower(self) -> NDArray[np.int64]:
        """The columns of the lower lid, from the inner to the outer corner."""
        return np.append(0, np.arange(self.rings.shape[1] - 1, UPPER_STEPS - 1, -1))


def _spline(points: Sequence[tuple[float, float]]) -> CubicSpline:
    at = np.array(points)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))])
    return CubicSpline(length / length[-1], at)


_upper, _lower = _spline(UPPER_EDGE), _spline(LOWER_EDGE)


def _place_along() -> Floats:
    """Return the place of each point along its lid, from inner to outer corner and back."""
    there = np.arange(UPPER_STEPS) / UPPER_STEPS
    back = 1 - np.arange(LOWER_STEPS) / LOWER_STEPS
    return np.concatenate([there, back]).astype(np.float32)


def _height(eye: Eye) -> float:
    return 1.0 if eye.mirror > 0 else RIGHT_LID_HEIGHT


def edge_heights(eye: Eye, x: Floats) -> tuple[Floats, Floats]:
    """Return the heights of the lower and the upper lid's edge in the front view."""
    along = np.linspace(0, 1, 200)
    lower, upper = (np.interp(x, *spline(along).T) for spline in (_lower, _upper))
    return np.asarray(lower * _height(eye)), np.asarray(upper * _height(eye))


def _edge(eye: Eye) -> Floats:
    along = _place_along()
    edge = np.concatenate([_upper(along[:UPPER_STEPS]), _lower(along[UPPER_STEPS:])])
    return np.asarray(edge * (1, _height(eye)), np.float32)


def hole_place(local: Floats) -> Floats:
    """Return the place of points (N, >= 2) relative to the hole: 0 its centre, 1 its border."""
    return np.asarray(np.linalg.norm((local[:, :2] - HOLE_CENTRE) / HOLE_HALF, axis=1), np.float32)


def _front(distance: Callable[[Floats], Floats], eye: Eye, flat: Floats) -> Floats:
    """Return the height of the foremost surface at places (N, 2) of the front view."""
    points = np.concatenate([flat, np.full((len(flat), 1), HIGHEST)], 1).astype(np.float32)
    for _ in range(TRACING_STEPS):
        points[:, 2] -= 0.6 * np.clip(distance(eye.world(points)), -0.3, 0.5)
    return points[:, 2]


def _shell(flat: Floats) -> Floats:
    """Return the height of a lid that lies on the eyeball."""
    radius = np.linalg.norm(flat, axis=1)
    heights = []
    for start, slope in (INNER_LINE, OUTER_LINE):
        on_eye = front_height(np.minimum(radius, start), LID_THICKNESS, SHELL_ROUNDING)
        heights.append(on_eye + slope * np.maximum(radius - start, 0))
    return np.asarray(np.where(flat[:, 0] < 0, *heights), np.float32)


def _skin(eye: Eye, edge: Floats) -> Floats:
    """Return the rings of the lids' skin, from the border of the hole to the edge (exclusive)."""
    middle = (edge.max(0) + edge.min(0)) / 2
    angle = np.arctan2(*((edge - middle) / np.ptp(edge, axis=0)).T[::-1])
    border = HOLE_CENTRE + np.stack([np.cos(angle), np.sin(angle)], 1) * HOLE_HALF
    place = np.repeat(np.array([1.0, *reversed(LID_RINGS)], np.float32), len(edge))
    count = len(place) // len(edge)
    start, end = np.tile(edge, (count, 1)), np.tile(border, (count, 1))
    flat = np.asarray(start + (end - start) * place[:, None], np.float32)

    above = np.tile(ramp(-0.15, 0.55, np.sin(angle)), count)
    below = np.tile(ramp(-0.15, 0.55, -np.sin(angle)), count)
    closed = _front(head_distance, eye, flat)
    lidless = _front(lidless_distance, eye, flat)
    outside = lidless + (closed - lidless) * ramp(0.72, 1.0, place)
    on_eye = ramp(0.95, 0.0, place) * (1 - above - below)
    on_eye += above * ramp(0.95, 0.10, place) + below * ramp(0.80, 0.0, place)
    height = outside + (_shell(flat) - outside) * on_eye

    # The crease fades out at both corners. The skin above it hangs over it.
    crease = above * ramp(1.75, 1.1, np.abs(flat[:, 0] - 0.05))
    hanging = ramp(CREASE - 0.03, CREASE + 0.10, place) * ramp(0.95, 0.50, place)
    height += crease * (0.075 * hanging - 0.05 * bell((place - CREASE) / 0.035))
    height += below * (0.14 * bell((place - 0.42) / 0.23) - 0.02 * bell((place - 0.80) / 0.08))
    return np.concatenate([flat, height[:, None]], 1).reshape(count, len(edge), 3)


def _contact(edge: Floats) -> Floats:
    """Return the places of the front view at which the margin touches the eyeball."""
    inward = np.roll(edge, 1, 0) - np.roll(edge, -1, 0)
    inward = np.stack([-inward[:, 1], inward[:, 0]], 1)
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    along = _place_along()
    lower = np.arange(len(edge)) > UPPER_STEPS
    shelf = np.where(lower, LOWER_SHELF, 0.0) * ramp(0, 0.25, along) * ramp(1, 0.85, along)
    contact = edge + inward * shelf[:, None]
    # Beyond WIDEST, spread the contact evenly over the eyeball between upper and lower lid.
    radius = np.linalg.norm(contact, axis=1)
    for corner in (0, UPPER_STEPS):
        rows = np.arange(corner - 20, corner + 21) % len(edge)
        wide = np.flatnonzero(radius[rows] > WIDEST)
        rows = rows[wide[0] - 1 : wide[-1] + 2]
        angles = np.unwrap(np.arctan2(contact[rows, 1], contact[rows, 0]))
        spread = np.linspace(angles[0], angles[-1], len(rows))
        size = np.linspace(radius[rows[0]], radius[rows[-1]], len(rows))
        inner = np.stack([np.cos(spread), np.sin(spread)], 1) * size[:, None]
        contact[rows[1:-1]] = inner[1:-1]
    return np.asarray(contact, np.float32)


def _behind_edge(edge: Floats, skin: Floats) -> Floats:
    """Return the rings from the edge over the margin to the back of the lids."""
    corner = np.concatenate([edge, _shell(edge)[:, None]], 1)
    contact = _contact(edge)
    radius = np.linalg.norm(contact, axis=1)
    touch = np.concatenate([contact, front_height(radius, GAP)[:, None]], 1)

    width = np.linalg.norm(touch - corner, axis=1, keepdims=True)
    rounded = corner + (touch - corner) * np.minimum(EDGE_ROUNDING / width, 0.5)
    rings = []
    for t in np.linspace(0, 1, EDGE_STEPS + 1)[1:]:
        rings.append((1 - t) ** 2 * skin + 2 * t * (1 - t) * corner + t * t * rounded)
    for step in range(1, MARGIN_STEPS + 1):
        ring = rounded + (touch - rounded) * (step / MARGIN_STEPS)
        if step < MARGIN_STEPS:
            x, y, spread, height = CARUNCLE
            bump = bell((ring[:, 0] - x) / spread, (ring[:, 1] - y) / spread)
            ring[:, 2] += height * bump
        rings.append(ring)

    polar = np.arctan2(radius, touch[:, 2])
    azimuth = contact / radius[:, None]
    for turn, gap in BACK:
        behind = polar + np.float32(np.radians(turn))
        size = eye_size(behind) + gap
        outward = azimuth * (size * np.sin(behind))[:, None]
        rings.append(np.concatenate([outward, (size * np.cos(behind))[:, None]], 1))
    return np.asarray(rings, np.float32)


def open_lids(eye: Eye) -> Opening:
    """Return the rings of the open lids of an eye."""
    edge = _edge(eye)
    skin = _skin(eye, edge)
    rings = np.concatenate([skin, _behind_edge(edge, skin[-1])]).astype(np.float32)
    return Opening(eye, rings, len(skin) - 1, len(skin) + EDGE_STEPS + MARGIN_STEPS - 1)


def skin_places() -> Floats:
    """Return the places of the skin's rings, from the border of the hole (1) inward, (R, 1)."""
    return np.array([1.0, *reversed(LID_RINGS)], np.float32)[:, None]


def closed_lids(opening: Opening) -> Floats:
    """Return the rings of an opening whose lids are closed, local, (rings, points, 3).

    The upper lid slides over the eyeball and overlaps the lower lid, which does not move. Vertices
    that touch the eyeball do not move either: on a straight line, they would enter it.
    """
    rings, edge = opening.rings.copy(), _edge(opening.eye)
    lower, upper = edge_heights(opening.eye, edge[:, 0])
    on_upper = np.arange(len(edge)) <= UPPER_STEPS
    share, lifted = (ramp(0.0, end, upper - lower) * on_upper for end in CLOSED_CORNER)
    shift = share * (lower - CLOSED_OVERLAP - edge[:, 1])

    place = skin_places()
    skin = rings[: opening.edge + 1]
    skin[..., 1] += shift * (1 - place) ** CLOSED_FALLOFF
    height = _shell(skin[..., :2].reshape(-1, 2)).reshape(skin.shape[:2]) + CLOSED_LIFT
    skin[..., 2] += lifted * ramp(*CLOSED_ON_EYE, place) * (height - skin[..., 2])

    closed = np.stack([edge[:, 0], edge[:, 1] + shift], 1)
    corner = np.concatenate([closed, (_shell(closed) + CLOSED_LIFT)[:, None]], 1)
    inward = np.array([0, 0, -1], np.float32)
    wanted = []
    for t in np.linspace(0, 1, EDGE_STEPS + 1)[1:]:
        on_edge = (1 - t) ** 2 * skin[-1] + (1 - (1 - t) ** 2) * corner
        wanted.append(on_edge + t * t * CLOSED_DEPTHS[0] * inward)
    wanted += [corner + depth * inward for depth in CLOSED_DEPTHS[1:]]
    parts = (*[1.0] * EDGE_STEPS, *CLOSED_PART)
    for ring, target, part in zip(rings[opening.edge + 1 :], wanted, parts, strict=False):
        ring += part * np.stack([share, share, lifted], 1) * (target - ring)
    return rings


def _border(faces: Faces, removed: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the vertices around the removed faces, counter-clockwise seen from outside."""
    sides = np.stack([faces, np.roll(faces, -1, 1)], 2)
    gone = {tuple(side) for side in sides[removed].reshape(-1, 2).tolist()}
    following = {a: b for a, b in gone if (b, a) not in gone}
    loop = [next(iter(sorted(following)))]
    while (after := following[loop[-1]]) != loop[0]:
        loop.append(after)
    if len(loop) != len(following):
        raise ValueError("the border of the hole around an eye touches itself")
    return np.array(loop)


def _from_angle_0(loop: Floats) -> NDArray[np.int64]:
    """Return the rows of a loop (N, 3), from the vertex at angle 0 in the front view on."""
    return np.roll(np.arange(len(loop)), -int(np.abs(np.arctan2(loop[:, 1], loop[:, 0])).argmin()))


def _stitched(outer: Floats, inner: Floats) -> NDArray[np.int64]:
    """Return triangles between two loops (N, 3), both counter-clockwise, as rows of their union.

    Each triangle advances on the loop whose next vertex is nearer.
    """
    points = np.concatenate([outer, inner])
    first, second = _from_angle_0(outer), len(outer) + _from_angle_0(inner)
    triangles = []
    i = j = 0
    while i < len(outer) or j < len(inner):
        a, b = first[i % len(outer)], second[j % len(inner)]
        after_a, after_b = first[(i + 1) % len(outer)], second[(j + 1) % len(inner)]
        to_a = np.linalg.norm(points[after_a] - points[b])
        to_b = np.linalg.norm(points[after_b] - points[a])
        if j == len(inner) or (i < len(outer) and to_a < to_b):
            triangles.append((b, a, after_a))
            i += 1
        else:
            triangles.append((b, a, after_b))
            j += 1
    return np.array(triangles)


def _tucked(opening: Opening, first: int) -> Tucked:
    """Return the vertices behind the edge; ``first`` is the row of the opening's first vertex."""
    count = opening.rings.shape[1]
    inner = opening.rings[opening.edge :]
    steps = np.linalg.norm(np.diff(inner, axis=0), axis=2)
    share = np.cumsum(steps, 0)
    share = TUCKED_REACH * share / share[-1]
    along = _place_along()
    target = 0.5 + TUCKED_SQUEEZE * (along - 0.5)
    upper = target * UPPER_STEPS
    lower = count - target * LOWER_STEPS
    edge = first + opening.edge * count
    anchors, weights = [np.broadcast_to(edge + np.arange(count), share.shape)], [1 - share]
    for at in (upper, lower):
        whole = np.floor(at).astype(np.int64)
        for row, part in ((whole, 1 - (at - whole)), (whole + 1, at - whole)):
            anchors.append(np.broadcast_to(edge + row % count, share.shape))
            weights.append(share * part / 2)
    rows = edge + count + np.arange(share.size)
    return Tucked(
        rows,
        np.stack(anchors, -1).reshape(-1, 5),
        np.stack(weights, -1).reshape(-1, 5).astype(np.float32),
    )


def _fill(mesh: Mesh, opening: Opening) -> tuple[Mesh, Tucked]:
    """Cut the hole of an eye into the mesh and fill it with the rings of the opening."""
    local = opening.eye.local(mesh.positions)
    size = np.linalg.norm(
        (local[:, :2] - HOLE_CENTRE) / (np.array(HOLE_HALF) + HOLE_MARGIN), axis=1
    )
    removed = ((size < 1) & (local[:, 2] > -2))[mesh.faces].any(1)
    border = _border(mesh.faces, removed)
    first = len(mesh.positions)
    count = opening.rings.shape[1]
    positions = np.concatenate([mesh.positions, opening.eye.world(opening.rings.reshape(-1, 3))])

    # Rings run clockwise around the left eye, seen from the front.
    ring = first + np.arange(count)
    ring = ring[::-1] if opening.eye.mirror > 0 else ring
    loops = [positions[rows] - opening.eye.centre for rows in (border, ring)]
    stitches = np.concatenate([border, ring])[_stitched(*loops)]
    filling = first + ring_faces(len(opening.rings), count)
    filling = filling if opening.eye.mirror > 0 else filling[:, ::-1]
    faces = np.concatenate([mesh.faces[~removed], stitches, filling]).astype(np.int32)
    normals = np.concatenate([mesh.normals, vertex_normals(positions, faces)[first:]])
    return Mesh(positions, normals, faces), _tucked(opening, first)


def with_open_eyes(
    closed: Mesh, openings: Sequence[Opening]
) -> tuple[Mesh, Tucked, list[NDArray[np.int64]]]:
    """Return the head with open lids.

    Also returns the vertices without texture coordinates of their own, and the vertices of each
    opening's rings, (rings, points).
    """
    mesh = closed
    tucked, rings = [], []
    for opening in openings:
        shape = opening.rings.shape[:2]
        rings.append(len(mesh.positions) + np.arange(np.prod(shape)).reshape(shape))
        mesh, found = _fill(mesh, opening)
        tucked.append(found)
    used, faces = np.unique(mesh.faces, return_inverse=True)
    renumbered = np.full(len(mesh.positions), -1)
    renumbered[used] = np.arange(len(used))
    return (
        Mesh(
            mesh.positions[used],
            mesh.normals[used],
            faces.reshape(mesh.faces.shape).astype(np.int32),
        ),
        Tucked(
            np.concatenate([renumbered[each.vertices] for each in tucked]),
            np.concatenate([renumbered[each.anchors] for each in tucked]),
            np.concatenate([each.weights for each in tucked]),
        ),
        [renumbered[rows] for rows in rings],
    )


@dataclass(frozen=True)
class Lids:
    """Weights, from 0 to 1, of the skin around open eyes; all 0 for closed eyes."""

    region: Floats  # skin that the closed head does not have
    wet: Floats  # margins and corners
    caruncle: Floats
    roots: Floats  # of the upper lashes
    white: Floats  # border of the corners' floors on the eyeball
    open_share: Floats  # fraction of the space around the point that is not occluded


def find_lids(points: Floats, eyes: Sequence[Eye]) -> Lids:
    """Return the weights at points (N, 3), in cm."""
    region, wet, caruncle, roots, white = (np.zeros(len(points), np.float32) for _ in range(5))
    open_share = np.ones(len(points), np.float32)
    for eye in eyes:
        local = eye.local(points)
        rows = np.flatnonzero((hole_place(local) < 1) & (local[:, 2] > -2))
        near = local[rows]
        x, y, _ = near.T
        region[rows] = ramp(1.0, 0.80, hole_place(near))
        lower, upper = edge_heights(eye, x)
        inner, outer = UPPER_EDGE[0][0], UPPER_EDGE[-1][0]
        inside = np.min([y - lower, upper - y, x - inner, outer - x], axis=0)
        depth = eye_distance(near)
        wet[rows] = np.maximum(ramp(-0.005, 0.035, inside), ramp(0.13, 0.08, depth))
        centre_x, centre_y, size, _ = CARUNCLE
        bump = bell((x - centre_x) / (1.2 * size), (y - centre_y) / (1.2 * size))
        caruncle[rows] = bump * wet[rows]
        roots[rows] = (
            bell((y - upper - 0.015) / 0.022) * ramp(-1.35, -0.8, x) * ramp(outer, 1.15, x)
        )
        white[rows] = ramp(0.16, 0.0, depth) * ramp(0.85, 1.05, np.abs(x)) * ramp(0, 0.05, inside)
        hollow = bell((x + 1.3) / 0.6, (y - 0.3) / 0.5)
        open_share[rows] = (1 - 0.25 * hollow) * (1 - 0.35 * ramp(0.0, 0.05, inside))
    return Lids(region, wet, caruncle, roots, white, open_share)
