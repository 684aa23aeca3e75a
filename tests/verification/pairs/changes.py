"""Changes that make the second image of a pair; a comparison must fail some and pass others. A
change takes a Room and returns the image, or None if it does not apply there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms, ImageFilter, ImageOps
from scipy.ndimage import binary_erosion, maximum_filter, minimum_filter

import facerender as fr
from facerender.images.files import png_bytes
from facerender.mesh.part import Part
from tests.meshes import with_geometry
from tests.verification.pairs.room import Linear, Patch, Room, draw_elsewhere

Format = Literal["exr", "png", "jpeg"]
Must = Literal["fail", "pass"]
Bytes = NDArray[np.uint8]
Places = tuple[NDArray[np.int64], ...]  # rows and columns of pixels
Encode = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Against:
    """An image with a golden of its own, other than the scene's golden.

    Attributes
    ----------
    name : file name of the golden
    samples : samples per pixel of both
    renderer : name of the renderer that drew the image; "" if it also drew the golden
    """

    name: str
    golden: Linear
    image: Linear
    samples: int
    renderer: str = ""


@dataclass(frozen=True)
class Change:
    """A change of the linear image.

    Attributes
    ----------
    formats : file formats of the pair; scenes of the group "judge" with a PNG also have a JPEG
    encode : maps linear values to [0, 1] for the 8-bit image; None for sRGB
    """

    name: str
    must: Must
    make: Callable[[Room], Linear | Against | None]
    formats: tuple[Format, ...] = ("exr", "png")
    encode: Encode | None = None


@dataclass(frozen=True)
class Encoded:
    """A change of the 8-bit image, which is written as PNG.

    Attributes
    ----------
    make : returns the content of the file, from the golden's pixels; None if it cannot hold them
    """

    name: str
    must: Must
    make: Callable[[Bytes], bytes | None]


# --- lobe, material and shading ------------------------------------------------------------------

SURFACE = "Surface s = surface(p);\n    vec3 v = s.view;"
_EXPONENTS = {
    "cook-torrance": ("exp2(-x) * sec2", "exp2(-{} * x) * sec2"),
    "ward": ("exp2(-4.1802625 - x)", "exp2(-4.1802625 - {} * x)"),
}


def exponent(by: float) -> Callable[[Room], Linear]:
    """Multiply the exponent of the exact lobe."""

    def make(room: Room) -> Linear:
        old, new = _EXPONENTS[room.setting.shading.term.model]
        return room.draw(patch=(old, new.format(by)))

    return make


def remade(change: Callable[[Any], Any]) -> Callable[[Room], Linear]:
    """Replace every material by ``change`` of it."""

    def make(room: Room) -> Linear:
        mesh = room.scene.mesh
        return room.draw(mesh=replace(mesh, materials=tuple(map(change, mesh.materials))))

    return make


def slope(by: float) -> Callable[[Room], Linear | None]:
    """Multiply the slope m of every material."""
    root = math.sqrt(by)
    materials = remade(
        lambda each: (
            replace(each, m=by * each.m)
            if each.roughness_map is None
            else replace(each, roughness_factor=root * each.roughness_factor)
        )
    )

    def make(room: Room) -> Linear | None:
        own = room.scene.mesh.materials
        too_large = any(each.roughness_map and root * each.roughness_factor > 1.0 for each in own)
        return surface(f"s.m *= {by};")(room) if too_large else materials(room)

    return make


def factor(name: str, by: float) -> Callable[[Room], Linear]:
    """Multiply one field of every material."""
    return remade(lambda each: replace(each, **{name: by * getattr(each, name)}))


def shaded(needs_factors: bool = False, **changes: Any) -> Callable[[Room], Linear | None]:
    """Replace fields of the shading.

    needs_factors : skip models without a Fresnel and a masking term
    """

    def make(room: Room) -> Linear | None:
        shading = room.setting.shading
        if needs_factors and not shading.term.entry.factors:
            return None
        return room.draw(shading=shading.replace(**changes))

    return make


def reflectance(room: Room) -> Linear | None:
    """Draw with f0 = 0.04 instead of 0.028."""
    factors = room.setting.shading.term.entry.factors
    return room.with_material(f0=0.04) if factors else None


def unclamped(room: Room) -> Against | None:
    """Draw D16 without its clamp; the golden is D16."""
    shading = room.setting.shading.replace(lobe="d16")
    mesh = room.scene.mesh.with_material(m=0.2)
    old = "clamp(1.0 - steepness * (1.0 - c), 0.0, 1.0)"
    golden = room.draw(shading=shading, mesh=mesh)
    image = room.draw(shading=shading, mesh=mesh, patch=(old, "1.0 - steepness * (1.0 - c)"))
    return Against("golden-d16", golden, image, room.renderer.samples)


# --- light ---------------------------------------------------------------------------------------


def turned(degrees: float) -> Callable[[Room], Linear]:
    """Turn the first light about the vertical axis through the mesh's centre."""

    def make(room: Room) -> Linear:
        mesh, (first, *others) = room.scene.mesh, room.scene.lights
        if first.position is None:
            moved = replace(first, azimuth=first.azimuth + degrees)
        else:
            x, y, z = mesh.normalised(first.position)
            angle = math.radians(degrees)
            sine, cosine = math.sin(angle), math.cos(angle)
            place = (x * cosine + z * sine, y, z * cosine - x * sine)
            moved = replace(first, position=tuple(mesh.to_mesh_space(place).tolist()))
        return room.draw(lights=(moved, *others))

    return make


def shadow_left_out(room: Room) -> Linear | None:
    if not any(light.shadow for light in room.scene.lights):
        return None
    return room.draw(lights=tuple(replace(each, shadow=False) for each in room.scene.lights))


def coloured(change: Callable[[Linear], Any]) -> Callable[[Room], Linear | None]:
    """Change the colours of the golden; the change does not apply if all stay equal."""

    def make(room: Room) -> Linear | None:
        image = room.golden.copy()
        image[..., :3] = change(image[..., :3])
        return None if np.array_equal(image, room.golden) else image

    return make


def exposed(by: float) -> Callable[[Room], Linear | None]:
    return coloured(lambda colors: colors * np.float32(by))


# --- the surface ---------------------------------------------------------------------------------


def surface(then: str, needs: str | None = None) -> Callable[[Room], Linear | None]:
    """Insert GLSL that changes the surface before it is shaded.

    needs : name of a map; the change applies only if a material has it
    """
    return patched(SURFACE, SURFACE.replace("\n", f"\n    {then}\n"), needs)


def patched(old: str, new: str, needs: str | None = None) -> Callable[[Room], Linear | None]:
    """Replace a passage of the GLSL."""
    return lambda room: room.draw(patch=(old, new)) if needs is None or has(room, needs) else None


def has(room: Room, name: str) -> bool:
    """Return whether any material has a map."""
    return any(getattr(each, name) is not None for each in room.scene.mesh.materials)


HALF = (
    "{{ vec3 e = exp2(floor(log2(max(abs({0}), vec3(1e-8)))) - 10.0); {0} = round({0} / e) * e; }}"
)
BYTES = "s.normal = normalize(round(s.normal * 127.0) / 127.0);"
GRAIN = (
    "s.normal = normalize(s.normal + 0.03 * (fract(43758.5453 * sin(dot(gl_FragCoord.xy,"
    " vec2(12.9898, 78.233)) + vec3(0.0, 1.7, 3.1))) - 0.5));"
)
ALONG: Patch = (
    "vec2 along = texel.xy * (2.0 * scale) - scale;",
    "vec2 along = texel.xy * (2.0 * scale) - scale; along.y = -along.y;",
)
ALBEDO = "s.albedo *= TEXEL(albedo_map, p, ALBEDO_MAP_UV).rgb;"
TWICE = "s.albedo *= pow(TEXEL(albedo_map, p, ALBEDO_MAP_UV).rgb, vec3(2.2));"


def half_vectors(room: Room) -> Linear:
    """Round the normal and the light's direction to half floats."""
    old = "float cosine = dot(s.normal, l);"
    new = f"{HALF.format('l')} {HALF.format('s.normal')} {old}"
    return room.draw(patch=(old, new))


def weaker_normals(room: Room) -> Linear | None:
    return factor("normal_strength", 0.95)(room) if has(room, "normal_map") else None


def blurred(room: Room) -> Linear | None:
    """Blur the albedo maps with a radius of 1/500 of their width."""
    if not has(room, "albedo_map"):
        return None

    def soft(texture: fr.Texture) -> fr.Texture:
        image = ImageOps.flip(texture.rgb())
        image = image.filter(ImageFilter.GaussianBlur(image.width / 500))
        return fr.Texture.from_image(image, texture.name).sampled(texture.wrap)

    return remade(lambda each: replace(each, albedo_map=each.albedo_map and soft(each.albedo_map)))(
        room
    )


def missing_faces(room: Room, count: int = 20) -> Linear:
    """Remove the ``count`` triangles of a part that are nearest to the point at a bright pixel."""
    (row, *_), (column, *_) = bright(room.golden, 1)
    seen = room.surface
    number = int(seen.part[row, column])
    mesh = room.scene.mesh
    part = mesh.parts[number]
    centres = mesh.normalised(part.positions[part.faces].mean(axis=1))
    away = np.linalg.norm(centres - seen.normalised_position[row, column], axis=1)
    left = np.sort(np.argsort(away)[count:])
    return room.draw(mesh=_with_part(room, number, replace(part, faces=part.faces[left])))


def _with_part(room: Room, number: int, part: Part) -> fr.Mesh:
    parts = list(room.scene.mesh.parts)
    parts[number] = part
    return with_geometry(room.scene.mesh, parts=tuple(parts))


# --- pixels and precision ------------------------------------------------------------------------


def grain(by: float) -> Callable[[Room], Linear | None]:
    """Multiply each pixel by noise with this standard deviation, the same in all channels."""

    def noisy(colors: Linear) -> Linear:
        noise = np.random.default_rng(1).normal(1.0, by, colors.shape[:2])
        return colors * noise[..., None].astype(np.float32)

    return coloured(noisy)


def eroded(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    return np.asarray(binary_erosion(mask, iterations=pixels))


def bright(linear: Linear, count: int, seed: int = 1) -> Places:
    """Choose pixels at least 5 pixels inside the silhouette, brighter than the median, where 5 x 5
    pixels differ by less than 20 %. At edges single pixels pass as slivers."""
    inside = eroded(linear[..., 3] >= 1.0, 5)
    level = linear[..., :3].min(axis=-1)
    around = linear[..., :3].max(axis=-1)
    smooth = minimum_filter(around, 5) > 0.8 * maximum_filter(around, 5)
    return _some(inside & smooth & (level > np.median(level[inside])), count, seed)


def edge(linear: Linear, count: int, seed: int = 1) -> Places:
    """Choose fully covered pixels next to the silhouette."""
    full = linear[..., 3] >= 1.0
    return _some(full & ~eroded(full, 1), count, seed)


def dark(linear: Linear, count: int, seed: int = 1) -> Places:
    """Choose pixels inside the silhouette: the darkest 0.1 % of all pixels above 0.001."""
    inside = eroded(linear[..., 3] >= 1.0, 3)
    level = linear[..., :3].max(axis=-1)
    inside &= level > 1e-3
    return _some(inside & (level <= np.quantile(level[inside], 1e-3)), count, seed)


def _some(mask: NDArray[np.bool_], count: int, seed: int) -> Places:
    chosen = np.random.default_rng(seed).choice(np.argwhere(mask), count, replace=False)
    return tuple(chosen.T)


def set_pixels(linear: Linear, where: Places, radiance: float) -> Linear:
    image = linear.copy()
    image[..., :3][where] = radiance
    return image


def pixels(
    where: Callable[[Linear, int], Places], count: int, radiance: float
) -> Callable[[Room], Linear]:
    return lambda room: set_pixels(room.golden, where(room.golden, count), radiance)


def packed(colors: Linear) -> Linear:
    """Round colours to r11g11b10 floats: 6, 6 and 5 bits of mantissa, no sign."""
    fraction, power = np.frexp(colors)
    steps = np.array([128.0, 128.0, 64.0], np.float32)
    return np.asarray(np.ldexp(np.round(fraction * steps) / steps, power))


def gamma(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """Encode linear values with a power of 1/2.2 instead of sRGB."""
    return np.asarray(np.clip(linear, 0.0, 1.0) ** (1.0 / 2.2))


# --- drivers, cameras and formats ----------------------------------------------------------------

FOUR = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
OTHER_FOUR = ((-0.375, -0.25), (0.125, -0.375), (-0.125, 0.25), (0.375, 0.375))


SOFTPIPE = {"GALLIUM_DRIVER": "softpipe", "LIBGL_ALWAYS_SOFTWARE": "1"}


def softpipe(room: Room) -> Against:
    """Draw on Mesa's softpipe, which has one sample per pixel."""
    setting = replace(room.setting, samples=1)
    return with_one_sample(room, draw_elsewhere(setting, variables=SOFTPIPE).linear, "softpipe")


def with_one_sample(room: Room, image: Linear, renderer: str) -> Against:
    if room.setting.samples == 1:
        return Against("golden", room.golden, image, 1, renderer)
    return Against("golden-1", room.draw(samples=1), image, 1, renderer)


def narrow(room: Room) -> Linear:
    """Draw on llvmpipe with vectors of 128 bits."""
    return draw_elsewhere(room.setting, variables={"LP_NATIVE_VECTOR_WIDTH": "128"}).linear


def osmesa(room: Room) -> Linear:
    return draw_elsewhere(room.setting, "osmesa").linear


def other_means(room: Room) -> Against | None:
    """Compare two means of four images whose samples lie at different positions in the pixel."""
    if room.setting.samples == 1:
        return None
    return Against("golden-mean", room.mean(FOUR), room.mean(OTHER_FOUR), 4)


def mirrored(room: Room) -> Against | None:
    """Mirror the sample positions. Both images show back faces too, because the mirrored scene is
    wound the other way."""
    if room.setting.samples == 1:
        return None
    both = room.scene.mesh.with_material(double_sided=True)
    image = room.mirrored(both)
    return Against("double-sided", room.draw(mesh=both), image, room.setting.samples)


def shifted(x: float, y: float) -> Callable[[Room], Linear | None]:
    """Move the sample of every pixel, in images with one sample per pixel."""

    def make(room: Room) -> Linear | None:
        if room.setting.samples > 1:
            return None
        return room.draw(view=room.view.shifted((x, y), room.size))

    return make


def moved(x: float, y: float) -> Callable[[Room], Linear]:
    """Move the camera by x and y pixels."""
    return lambda room: room.draw(view=room.moved((x, y)))


def snapped(room: Room) -> Linear:
    """Move every vertex so that it projects to multiples of 1/256 of a pixel."""
    mesh, matrix = room.scene.mesh, room.view.matrix
    halves = np.divide(room.size, 2.0)
    parts = []
    for part in mesh.parts:
        places = mesh.normalised(part.positions)
        clip = np.column_stack([places, np.ones(len(places))]) @ matrix
        pixels = clip[:, :2] / clip[:, 3:] * halves
        clip[:, :2] = np.round(256.0 * pixels) / 256.0 / halves * clip[:, 3:]
        back = np.linalg.solve(matrix.T, clip.T).T[:, :3]
        parts.append(replace(part, positions=np.ascontiguousarray(mesh.to_mesh_space(back))))
    return room.draw(mesh=with_geometry(mesh, parts=tuple(parts)), view=room.view)


def reversed_triangles(room: Room) -> Linear:
    mesh = room.scene.mesh
    parts = tuple(
        replace(part, faces=np.ascontiguousarray(part.faces[::-1])) for part in mesh.parts
    )
    return room.draw(mesh=with_geometry(mesh, parts=parts))


def dithered(image: Bytes) -> bytes:
    """Add -1, 0 or 1 level to each colour value at random; alpha stays."""
    steps = np.random.default_rng(1).integers(-1, 2, (*image.shape[:2], 3))
    out = image.copy()
    out[..., :3] = np.clip(image[..., :3] + steps, 0, 255)
    return png_bytes(out, {})


def with_profile(image: Bytes) -> bytes:
    """Write a PNG with an sRGB profile."""
    file = BytesIO()
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(image).save(file, "PNG", icc_profile=profile)
    return file.getvalue()


def changes() -> Iterator[Change | Encoded]:
    """Yield every change."""
    fail: dict[str, Callable[[Room], Linear | Against | None]] = {
        "exponent +2 %": exponent(1.02),
        "exponent +5 %": exponent(1.05),
        "m +1 %": slope(1.01),
        "m -1 %": slope(0.99),
        "m +3 %": slope(1.03),
        "f0 0.028 to 0.04": reflectance,
        "no masking": shaded(True, masking="none"),
        "ks -3 %": factor("ks", 0.97),
        "light turned by 0.5 degrees": turned(0.5),
        "light turned by 2 degrees": turned(2.0),
        "shadow left out": shadow_left_out,
        "exposure +1 %": exposed(1.01),
        "exposure -1 %": exposed(0.99),
        "exposure +2 %": exposed(1.02),
        "green of the normals inverted": patched(*ALONG, needs="normal_map"),
        "normal map's strength 0.95": weaker_normals,
        "normals in 8 bits": surface(BYTES),
        "normals in half floats": surface(HALF.format("s.normal")),
        "grain in the normals": surface(GRAIN),
        "albedo decoded twice": patched(ALBEDO, TWICE, needs="albedo_map"),
        "albedo's red +2 %": surface("s.albedo *= vec3(1.02, 1.0, 1.0);"),
        "albedo blurred": blurred,
        "20 triangles missing": missing_faces,
        "grain of 2 %": grain(0.02),
        "2 black pixels": pixels(bright, 2, 0.0),
        "3 black pixels at the silhouette": pixels(edge, 3, 0.0),
        "5 black pixels in the dark": pixels(dark, 5, 0.0),
        "3 fireflies": pixels(bright, 3, 4.0),
        "12 false highlights at the silhouette": pixels(edge, 12, 1.0),
        "D16 not clamped": unclamped,
        "r11g11b10": coloured(packed),
        "vectors in half floats": half_vectors,
        "other diffuse term": shaded(True, diffuse="coupled"),
        "D4 in place of exact": shaded(lobe="d4", outside="exact"),
        "D8 in place of exact": shaded(lobe="d8", outside="exact"),
    }
    for name, make in fail.items():
        yield Change(name, "fail", make)
    yield Change("highlights clamped", "fail", coloured(lambda x: np.minimum(x, 1.0)), ("exr",))
    yield Change("gamma 2.2", "fail", lambda room: room.golden, ("png",), gamma)
    harmless: dict[str, Callable[[Room], Linear | Against | None]] = {
        "camera moved by 0.02 pixels in x": moved(0.02, 0.0),
        "camera moved by 0.02 pixels in y": moved(0.0, 0.02),
        "camera moved by 0.05 pixels": moved(0.05, 0.0),
        "mean of other samples": other_means,
        "samples mirrored": mirrored,
        "sample moved by 0.05 pixels": shifted(0.03, -0.04),
        "sample moved by 0.1 pixels": shifted(-0.06, 0.08),
        "vertices snapped": snapped,
        "triangles reversed": reversed_triangles,
        "vectors of 128 bits": narrow,
        "OSMesa": osmesa,
        "softpipe": softpipe,
    }
    for name, make in harmless.items():
        yield Change(name, "pass", make)
    yield Change("noise of 5e-4", "pass", grain(5e-4), ("exr",))
    yield Encoded("dither of 1 step", "pass", dithered)
    yield Encoded("sRGB profile", "pass", with_profile)


CHANGES = {each.name: each for each in changes()}
