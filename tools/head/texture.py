"""The maps of the skin, computed from the 3D positions of texels.

Colours are linear until the output; heights and distances are in cm.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from .eyes import Eye
from .fields import Floats, bell, ramp
from .hairs import brow_cover, lash_cover
from .landmarks import hairline
from .lids import Lids, find_lids
from .mouth import GUMS_RING, TEETH_RING, TONGUE_RING, Lining, find_lining
from .noise import Noise, nearest, scatter
from .regions import Regions, find_regions
from .shape import fine_head_distance, gradient, head_distance, in_blocks, unit
from .surface import Mesh
from .unwrap import MOUTH_CENTRE, MOUTH_RADIUS, Texels, Unwrapped, find_texels

Colour = tuple[float, float, float]

# 8-bit sRGB colours.
SKIN: Colour = (224, 180, 156)
LIPS: Colour = (182, 108, 100)
STUBBLE: Colour = (92, 84, 84)
SCALP_HAIR: Colour = (62, 51, 45)
BROW: Colour = (58, 44, 36)
LASHES: Colour = (46, 34, 30)
LID_MARGIN: Colour = (206, 142, 126)
CARUNCLE: Colour = (198, 116, 106)
LID_WHITE: Colour = (204, 158, 146)  # at the border of the corners and the sclera

# The lining of the mouth. It is darker towards the throat, because a renderer may draw no shadows.
INNER_LIPS: Colour = (166, 84, 80)
VESTIBULE: Colour = (104, 42, 42)
GUMS: Colour = (150, 74, 74)
TOOTH: Colour = (226, 208, 180)
BEHIND_TEETH: Colour = (96, 56, 50)
CHEEK: Colour = (60, 22, 22)  # at the corners, instead of teeth
PALATE: Colour = (88, 34, 32)
TONGUE: Colour = (150, 72, 70)
THROAT: Colour = (26, 8, 8)
# (Number of rings from the lips, colour of the upper half, colour of the lower half).
LINING = (
    (0.0, INNER_LIPS, INNER_LIPS),
    (1.0, INNER_LIPS, INNER_LIPS),
    (GUMS_RING - 1.0, VESTIBULE, VESTIBULE),
    (GUMS_RING + 0.0, GUMS, GUMS),
    (GUMS_RING + 0.30, GUMS, GUMS),
    (GUMS_RING + 0.45, TOOTH, TOOTH),
    (TEETH_RING + 0.6, TOOTH, TOOTH),
    (TEETH_RING + 1.4, BEHIND_TEETH, BEHIND_TEETH),
    (TONGUE_RING + 0.0, PALATE, TONGUE),
    (TONGUE_RING + 1.2, THROAT, THROAT),
)
# Places of the gaps between the teeth, from the middle line (0) to the corner of the mouth (1).
TOOTH_GAPS = (0.0, 0.30, 0.52, 0.76)
TOOTH_GAP, TOOTH_GAP_DEPTH = 0.018, 0.45  # width (standard deviation), loss of light

# Absorption of red, green and blue by one unit of a pigment: the exponent of its transmission.
BLOOD: Colour = (0.03, 0.26, 0.24)
MELANIN: Colour = (0.26, 0.46, 0.71)
CAROTENE: Colour = (0.00, 0.02, 0.14)
VEIN: Colour = (0.11, 0.05, -0.016)

# Number of marks on the whole head, and the size of each (standard deviation, cm).
PORES, PORE_SIZE = 110_000, 0.022
NOSE_PORES, NOSE_PORE_SIZE = 30_000, 0.030
FOLLICLES, FOLLICLE_SIZE = 150_000, 0.020
STUBBLES, STUBBLE_SIZE = 30_000, 0.017
FRECKLES, FRECKLE_SIZE = 900, 0.018
MOLES, MOLE_SIZE = 9, 0.045
REACH = 0.15  # largest distance at which a mark is visible, cm

# Heights of the fine relief in the normal map, cm.
PORE_DEPTH = 0.0075
NOSE_PORE_DEPTH = 0.0085
LUMP_HEIGHT = 0.0030
SKIN_LINE_HEIGHT = 0.0020
LIP_FURROW_HEIGHT = 0.006
LID_LINE_HEIGHT = 0.004
FOREHEAD_LINE_DEPTH = 0.005
UNDER_EYE_LINE_DEPTH = 0.003
CROWS_FOOT_DEPTH = 0.006
CROWS_FOOT_HEIGHT = -0.1  # y of the eye corner from which the lines radiate, cm
SCALP_HAIR_HEIGHT = 0.005
BROW_HEIGHT = 0.010
LASH_HEIGHT = 0.006
STEEPEST = 0.6  # maximum slope of the fine relief
SHALLOWEST = 0.50  # minimum component of a mapped normal along the mesh normal, before scaling to 1
NOSTRIL_OPENING = (0.0, -0.95, 0.31)  # direction from which light enters the nostrils

OCCLUSION_REACH = (0.12, 0.3, 0.6, 1.1, 1.8)  # distances along the normal of occlusion samples, cm
OCCLUSION_STRENGTH = 0.62
MOUTH_OPEN = ((0, 0.9), (3, 0.6), (5, 0.7), (8, 0.45), (10, 0.1))  # (ring of the mouth, open share)

# Roughness m of the skin, the RMS slope: a base value, and the offset of each region.
SLOPE_BASE = 0.33
SLOPE_ADDED = {
    "nose": -0.07,
    "forehead": -0.05,
    "nose_bridge": -0.04,
    "cheek": 0.03,
    "beard": 0.06,
    "lips": -0.08,
    "eyelid": -0.02,
    "scalp": 0.10,
    "nostril": 0.15,
}
SLOPE_ADDED_WET = -0.07  # on the margins of open lids
SLOPE_MOUTH = 0.27
SLOPE_RANGE = (0.205, 0.54)  # at least 0.2 after rounding: the plain half vector needs it


@dataclass(frozen=True)
class Maps:
    """The textures of the head as images, row 0 at the top."""

    albedo: Image.Image
    normal: Image.Image
    occlusion_roughness: Image.Image  # red: occlusion, green: square root of m


@dataclass(frozen=True)
class Scattered:
    """The nearest of many marks on the skin, for each texel."""

    distance: Floats  # distance to the mark, cm; infinite beyond REACH
    rank: Floats  # random number of the mark, from 0 to 1


@dataclass(frozen=True)
class Marks:
    """The marks on the skin, and the coverage of each texel by brows and lashes."""

    pores: Scattered
    nose_pores: Scattered
    follicles: Scattered
    stubbles: Scattered
    freckles: Scattered
    moles: Scattered
    brow: Floats
    brow_shade: Floats
    lash: Floats


def linear(colour: Colour) -> Floats:
    """Convert 8-bit sRGB to linear."""
    value = np.array(colour, np.float32) / 255
    return np.where(value < 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def encoded(colour: Floats) -> Floats:
    """Convert linear to sRGB, in [0, 1]."""
    value = np.clip(colour, 0, 1)
    return np.where(value < 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)


def absorb(colour: Floats, amount: Floats, pigment: Colour) -> Floats:
    """Return colours (N, 3) behind an amount (N,) of a pigment."""
    return np.asarray(colour * np.exp(-amount[:, None] * np.array(pigment, np.float32)), np.float32)


def cover(colour: Floats, amount: Floats, over: Colour) -> Floats:
    """Return colours (N, 3) behind an opaque colour with the coverage ``amount`` (N,)."""
    share = amount[:, None]
    return np.asarray(colour * (1 - share) + linear(over) * share, np.float32)


# Relative densities of marks at points (N, 3).


def _pore_density(points: Floats) -> Floats:
    return np.asarray(0.25 + ramp(0, 5, points[:, 2]), np.float32)


def _nose_pore_density(points: Floats) -> Floats:
    near_nose = bell(points[:, 0] / 2.2, (points[:, 1] + 3) / 2.2)
    return 0.05 + near_nose * (points[:, 2] > 6)


def _follicle_density(points: Floats) -> Floats:
    return np.asarray(hairline(points) > -1.6, np.float32)


def _stubble_density(points: Floats) -> Floats:
    _, y, z = points.T
    return np.asarray((y < -4) & (y > -13) & (z > -1), np.float32)


def _freckle_density(points: Floats) -> Floats:
    x, y, _ = points.T
    on_cheeks = bell(np.asarray((np.abs(x) - 2.2) / 2.2, np.float32), (y + 2.4) / 1.6)
    return 0.03 + on_cheeks * (points[:, 2] > 5)


def _mole_density(points: Floats) -> Floats:
    off_centre = (points[:, 2] > 1) & (np.abs(points[:, 0]) > 2.5)
    return np.asarray(0.1 + off_centre, np.float32)


def _scatter_marks(mesh: Mesh, points: Floats, random: np.random.Generator) -> Marks:
    def scattered(count: int, density: Callable[[Floats], Floats]) -> Scattered:
        seeds = scatter(mesh, count, random, density)
        rank = random.random(count).astype(np.float32)
        distance, index = nearest(points, seeds, REACH)
        return Scattered(distance, rank[index])

    brow, brow_shade = brow_cover(points, random)
    lash = lash_cover(points, random)
    in_front = ramp(2, 5, points[:, 2])
    return Marks(
        pores=scattered(PORES, _pore_density),
        nose_pores=scattered(NOSE_PORES, _nose_pore_density),
        follicles=scattered(FOLLICLES, _follicle_density),
        stubbles=scattered(STUBBLES, _stubble_density),
        freckles=scattered(FRECKLES, _freckle_density),
        moles=scattered(MOLES, _mole_density),
        brow=brow * in_front,
        brow_shade=brow_shade * in_front,
        lash=lash * in_front,
    )


def _fine_height(points: Floats, regions: Regions, marks: Marks, noise: Noise) -> Floats:
    """Return the height of relief that is too fine for the mesh: pores, lines, hairs."""
    x, y, _ = points.T
    side = np.abs(x)
    skin = regions.plain_skin
    pore_depth = 0.45 + 0.9 * regions.nose + 0.5 * regions.cheek
    pore_depth += 0.35 * regions.forehead + 0.4 * regions.chin
    height = -PORE_DEPTH * pore_depth * skin * bell(marks.pores.distance / PORE_SIZE)
    nose_pores = regions.nose + 0.45 * regions.nose_bridge + 0.5 * regions.cheek
    height -= NOSE_PORE_DEPTH * nose_pores * skin * bell(marks.nose_pores.distance / NOSE_PORE_SIZE)
    height += LUMP_HEIGHT * skin * noise(points, 2.6, 21, layers=3)
    height += SKIN_LINE_HEIGHT * skin * noise(points, 9, 27, layers=2)
    furrows = noise(points, 6.5, 31, layers=3, stretch=(1, 0.16, 0.35))
    lid_lines = noise(points, 6, 29, layers=2, stretch=(0.25, 1, 0.25))
    height += LID_LINE_HEIGHT * regions.eyelid * lid_lines
    height += LIP_FURROW_HEIGHT * regions.lips * furrows

    wave = np.sin(2.2 * (y + 0.0072 * x * x + 0.15 * noise(points, 0.5, 41)))
    across_forehead = regions.forehead * ramp(6.2, 5, y) * ramp(4.6, 3, side)
    height -= FOREHEAD_LINE_DEPTH * across_forehead * bell((wave - 1) / 0.12)
    wave = np.sin(16 * (y + 0.22 * (side - 2.9)) + 1.5 * noise(points, 1.2, 43))
    height -= UNDER_EYE_LINE_DEPTH * regions.under_eye * wave
    # Crow's feet are rays from the outer corner of the eye.
    out, up = side - 4.55, y - CROWS_FOOT_HEIGHT
    ray = np.arctan2(up, out) + 0.12 * noise(points, 1.1, 45)
    near_corner = ramp(0.25, 0.7, out) * ramp(2.0, 1.1, out) * bell(up / 0.6) * (points[:, 2] > 3)
    height -= CROWS_FOOT_DEPTH * near_corner * bell((np.cos(9 * ray) - 1) / 0.25)

    height += SCALP_HAIR_HEIGHT * regions.scalp * noise(points, 9, 51, layers=2)
    height += BROW_HEIGHT * marks.brow + LASH_HEIGHT * marks.lash
    return np.asarray(height, np.float32)


def _tangent_normals(texels: Texels, height: Floats, nostril: Floats, unfolded: Floats) -> Floats:
    """Return tangent-space normals: x along u, z along the mesh normal.

    They encode the normals of the surface with its fine folds, tilted by the slope of ``height``.
    ``unfolded`` is the weight of surfaces that the closed head does not have: they get no folds.
    Inside the nostrils, normals point to the opening. Otherwise a renderer without shadows would
    light their walls through the skin.
    """
    normals = texels.normals
    along_u, along_v = texels.differences(texels.positions)
    height_u, height_v = texels.differences(height)
    # Gradient of the height in space, from its changes along u and v, which may be non-orthogonal.
    uu, vv = (along_u * along_u).sum(1), (along_v * along_v).sum(1)
    uv = (along_u * along_v).sum(1)
    area = uu * vv - uv * uv
    # Texels at the border of a chart get no relief: their neighbours are elsewhere on the head.
    whole = (uu < 0.04) & (vv < 0.04) & (area > 0.01 * uu * vv)
    area = np.where(whole, area, np.inf)
    slope = ((vv * height_u - uv * height_v) / area)[:, None] * along_u
    slope += ((uu * height_v - uv * height_u) / area)[:, None] * along_v
    steepness = np.linalg.norm(slope, axis=1, keepdims=True)
    slope *= np.minimum(1, STEEPEST / np.maximum(steepness, 1e-6))

    folded = unit(gradient(fine_head_distance, texels.positions, 0.018))
    trusted = ramp(0.35, 0.8, (folded * normals).sum(1)) * whole * (1 - unfolded)
    wanted = normals + (folded - normals) * trusted[:, None] - slope
    wanted += (np.array(NOSTRIL_OPENING, np.float32) - wanted) * nostril[:, None]

    tangent = unit(along_u - (along_u * normals).sum(1, keepdims=True) * normals)
    bitangent = np.cross(normals, tangent)
    depth = np.maximum((wanted * normals).sum(1), SHALLOWEST)
    in_frame = np.stack([(wanted * tangent).sum(1), (wanted * bitangent).sum(1), depth], 1)
    return unit(np.asarray(in_frame, np.float32))


def _open_share(points: Floats, normals: Floats, distance: Callable[[Floats], Floats]) -> Floats:
    blocked = np.zeros(len(points), np.float32)
    for step, reach in enumerate(OCCLUSION_REACH):
        outside = points + normals * np.float32(reach)
        missing = np.clip(reach - in_blocks(distance, outside), 0, None)
        blocked += missing / reach * 0.5**step
    return np.asarray(np.clip(1 - OCCLUSION_STRENGTH * blocked, 0, 1))


def _occlusion(texels: Texels, regions: Regions, lids: Lids, lining: Lining) -> Floats:
    """Return the unoccluded fraction of the space around each point, from 0 to 1."""
    open_share = _open_share(texels.positions, texels.normals, head_distance)
    at_eye = np.flatnonzero(lids.region)
    if len(at_eye):
        share = lids.region[at_eye]
        wanted = lids.open_share[at_eye]
        open_share[at_eye] += (wanted - open_share[at_eye]) * share
    open_share[lining.inside] = np.interp(lining.ring, *np.transpose(MOUTH_OPEN))
    return np.asarray(open_share * (1 - 0.4 * regions.nostril), np.float32)


def _skin_colour(points: Floats, regions: Regions, marks: Marks, noise: Noise) -> Floats:
    """Return the colour of skin without hair: pigments over a uniform base."""
    blood = 0.16 * noise(points, 0.35, 71, layers=3) + 0.15 * noise(points, 1.8, 73, layers=3)
    blood += 0.13 * noise(points, 8, 75, layers=2)
    blood += 0.85 * regions.cheek + 0.80 * regions.nose + 0.35 * regions.nose_wings
    blood += 0.25 * regions.nose_bridge + 0.30 * regions.chin + 0.75 * regions.ear
    blood += 0.75 * regions.eyelid + 0.35 * regions.under_eye - 0.15 * regions.forehead
    melanin = 0.06 * noise(points, 0.22, 61, layers=3) + 0.07 * noise(points, 1.4, 63, layers=4)
    melanin += 0.05 * noise(points, 9, 65, layers=2)
    melanin += 0.26 * regions.eyelid + 0.22 * regions.under_eye
    melanin += 0.10 * bell((points[:, 1] + 12.5) / 1.5)
    carotene = 0.12 * regions.forehead + 0.08 * regions.neck
    vein = np.clip(1 - 9 * np.abs(noise(points, 0.75, 81, layers=3)), 0, 1)

    colour = np.tile(linear(SKIN), (len(points), 1)).astype(np.float32)
    colour = absorb(colour, np.clip(blood, -1, 3), BLOOD)
    colour = absorb(colour, melanin, MELANIN)
    colour = absorb(colour, carotene, CAROTENE)
    colour = absorb(colour, vein * (0.35 * regions.under_eye + 0.25 * regions.temple), VEIN)
    pore = 0.10 * bell(marks.pores.distance / PORE_SIZE) * regions.plain_skin
    pore *= 0.4 + 0.6 * np.clip(regions.nose + regions.cheek, 0, 1)
    colour = absorb(colour, pore, (0.6, 1.0, 1.0))
    strength = marks.freckles.rank**2
    freckle = bell(marks.freckles.distance / (FRECKLE_SIZE + 0.035 * strength))
    colour = absorb(colour, freckle * (0.10 + 0.22 * strength), (0.5, 0.9, 1.2))
    strength = marks.moles.rank
    mole = ramp(1.25, 0.75, marks.moles.distance / (MOLE_SIZE + 0.05 * strength))
    return absorb(colour, mole * (0.35 + 0.6 * strength), (0.8, 1.15, 1.3))


def _add_lips(colour: Floats, points: Floats, regions: Regions, noise: Noise) -> Floats:
    furrow = 1 + 0.07 * noise(points, 5, 91, layers=3, stretch=(1, 0.2, 0.4))
    lighter_below = 1 + 0.12 * (regions.lower_lip - regions.upper_lip)
    lips = linear(LIPS) * (furrow * lighter_below)[:, None]
    opacity = np.clip(0.72 + 0.07 * noise(points, 4, 95, layers=2), 0.55, 0.85)
    share = (regions.lips * opacity)[:, None]
    return np.asarray(colour * (1 - share) + lips * share, np.float32)


def _add_hair(
    colour: Floats, points: Floats, regions: Regions, marks: Marks, noise: Noise
) -> Floats:
    # Hairs become sparse towards the edge of scalp and beard: a hair appears if the region's weight
    # exceeds the hair's rank.
    shadow = 0.16 * (1 + 0.4 * noise(points, 2, 97, layers=2))
    single = (
        0.55 * bell(marks.stubbles.distance / STUBBLE_SIZE) * (marks.stubbles.rank < regions.beard)
    )
    stubble = regions.beard * shadow + single * np.sqrt(regions.beard)
    colour = cover(colour, stubble, STUBBLE)
    shadow = 0.66 * regions.scalp**1.5 * (1 + 0.03 * noise(points, 3, 99, layers=2))
    single = (
        0.40
        * bell(marks.follicles.distance / FOLLICLE_SIZE)
        * (marks.follicles.rank < regions.scalp)
    )
    scalp = shadow + single
    colour = cover(colour, np.clip(scalp, 0, 0.93), SCALP_HAIR)
    colour = cover(colour, np.clip(marks.brow + 0.28 * marks.brow_shade, 0, 0.93), BROW)
    return cover(colour, np.clip(marks.lash, 0, 0.88), LASHES)


def _albedo(
    points: Floats,
    regions: Regions,
    marks: Marks,
    noise: Noise,
    occlusion: Floats,
    lids: Lids,
    lining: Lining,
) -> Floats:
    colour = _skin_colour(points, regions, marks, noise)
    colour = _add_lips(colour, points, regions, noise)
    colour = _add_hair(colour, points, regions, marks, noise)
    colour = cover(colour, 0.85 * lids.wet, LID_MARGIN)
    colour = cover(colour, 0.80 * lids.caruncle, CARUNCLE)
    colour = cover(colour, lids.white, LID_WHITE)
    colour = cover(colour, 0.5 * lids.roots, LASHES)
    # Pits reflect less light, and redder light.
    open_share = 0.60 + 0.40 * occlusion
    open_share = open_share * (1 - 0.45 * regions.nostril) * (1 - 0.36 * regions.mouth_seam)
    colour = colour * np.stack([open_share**0.75, open_share, open_share], 1)
    colour[lining.inside] = _lining_colour(lining)
    return np.asarray(colour)


def _lining_colour(lining: Lining) -> Floats:
    """Return the colours of the points in the mouth."""
    ring, side = lining.ring, lining.side
    rings = [row[0] for row in LINING]
    halves = []
    for colours in ([row[1] for row in LINING], [row[2] for row in LINING]):
        channels = np.transpose([linear(each) for each in colours])
        halves.append(np.stack([np.interp(ring, rings, channel) for channel in channels], 1))
    colour = np.where(lining.upper[:, None], *halves)
    tooth = ramp(GUMS_RING + 0.2, GUMS_RING + 0.5, ring) * ramp(TEETH_RING + 1, TEETH_RING, ring)
    gaps = np.sum([bell((side - np.float32(gap)) / TOOTH_GAP) for gap in TOOTH_GAPS], axis=0)
    light = 1 - TOOTH_GAP_DEPTH * gaps * tooth
    light *= 1 - 0.5 * ramp(0.4, 0.8, side) * ramp(1, 2, ring)
    colour = cover(colour * light[:, None], ramp(0.72, 0.82, side) * ramp(1, 2.5, ring), CHEEK)
    return np.asarray(colour * light[:, None], np.float32)


def _rms_slope(
    points: Floats, regions: Regions, noise: Noise, lids: Lids, lining: Lining
) -> Floats:
    slope = SLOPE_BASE + 0.02 * noise(points, 1.5, 101, layers=3) + SLOPE_ADDED_WET * lids.wet
    for region, added in SLOPE_ADDED.items():
        slope = slope + added * getattr(regions, region)
    slope[lining.inside] = SLOPE_MOUTH
    return np.asarray(np.clip(slope, *SLOPE_RANGE), np.float32)


def _picture(texels: Texels, values: Floats) -> Image.Image:
    """Convert values in [0, 1] at the covered texels to an 8-bit image, row 0 at the top."""
    image = np.clip(255 * texels.image(values) + 0.5, 0, 255).astype(np.uint8)
    return Image.fromarray(image[::-1])


def paint(unwrapped: Unwrapped, size: int, seed: int, closed: Mesh, eyes: Sequence[Eye]) -> Maps:
    """Compute the maps; ``size`` is their width in texels, halved for occlusion and roughness.

    The marks of the skin are scattered on the ``closed`` head, so that they do not depend on the
    ``eyes`` that are open.
    """
    random = np.random.default_rng(seed)
    noise = Noise(seed)
    texels = find_texels(unwrapped, size)
    points = texels.positions
    regions = find_regions(points, noise)
    lids = find_lids(points, eyes)
    place = (np.argwhere(texels.covered)[:, ::-1] + 0.5) / size
    lining = find_lining(np.asarray((place - MOUTH_CENTRE) / MOUTH_RADIUS, np.float32))
    marks = _scatter_marks(closed, points, random)
    marks = replace(marks, lash=marks.lash * (1 - lids.region))
    occlusion = _occlusion(texels, regions, lids, lining)

    height = _fine_height(points, regions, marks, noise)
    height[lining.inside] = 0
    unfolded = np.maximum(lids.region, lining.inside)
    normals = _tangent_normals(texels, height, regions.nostril, unfolded)
    albedo = _albedo(points, regions, marks, noise, occlusion, lids, lining)
    roughness = np.sqrt(_rms_slope(points, regions, noise, lids, lining))
    combined = np.stack([occlusion, roughness, np.zeros_like(occlusion)], 1)
    half = (size // 2, size // 2)
    return Maps(
        albedo=_picture(texels, encoded(albedo)),
        normal=_picture(texels, normals * 0.5 + 0.5),
        occlusion_roughness=_picture(texels, combined).resize(half, Image.Resampling.BOX),
    )
