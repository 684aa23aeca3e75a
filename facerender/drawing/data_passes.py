"""The passes of data images and of G-buffers, which show the centres of the pixels. The passes of
images are in ``frame_passes``.

Data images need a few planes (:func:`plane_passes`), the visible fraction of each light
(:func:`fraction_passes`) or the visible triangles (:func:`triangle_pass`). The reference needs the
G-buffer (:func:`surface_passes`). Planes follow the passes of an image in one frame, if there is
one, and share its pass "visible" where this is drawn at the centres of the pixels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from facerender.drawing.frame_passes import Structure, numbered, visible_pass
from facerender.drawing.passes import Draw, Order, Pass, Target, depth_only, mask_features
from facerender.drawing.prepare import Appearance, ResolvedPart
from facerender.drawing.program import Program, shadow_features, surface_features
from facerender.drawing.shadows import MOST, shadow_passes
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading

# Triangles per unit of the second channel that depth.frag writes: float32 does not represent all
# indices above 2^24.
INDEX_BASE = 4096
# Planes of data images by name: number of channels, see ``shaders/host/gbuffer.frag``.
PLANES = {"depth": 2, "position": 4, "normal": 4, "albedo": 4}


@dataclass(frozen=True)
class Layer:
    """One layer of a blended part. Depth peeling shows the surface with this index at each pixel; 0
    is the nearest surface.

    part : index of the part
    """

    part: int
    index: int = 0


def surface_images(scene: Scene, layer: bool) -> tuple[str, ...]:
    """Return the names of the images of a G-buffer in drawing order:

    - position: position, index of the part plus 1
    - normal: normal, m
    - albedo: albedo, specular weight
    - uv: texture coordinates, occlusion, and either facing (if a part scatters) or opacity (of a
      layer)
    - lobes: m of the second lobe and weight of the first lobe, if a part has two lobes
    - emitted: emission, with the refracted light, if a part emits or refracts light
    - layer: depth, and index of the triangle in drawing order, of a layer

    layer : whether the G-buffer is one layer of a blended part
    """
    materials = scene.mesh.materials
    lobes = ("lobes",) * any(material.two_lobes for material in materials)
    emitted = ("emitted",) * any(material.emits for material in materials)
    return ("position", "normal", "albedo", "uv", *lobes, *emitted, *("layer",) * layer)


def plane_passes(of: Structure, names: Sequence[str], image: bool) -> list[Pass]:
    """Return the passes that draw planes of all parts that are not blended, and of the parts
    ``of.cut``.

    names : of PLANES
    image : whether the passes of an image are drawn before
    """
    parts = *of.look.unblended, *of.cut
    draws = [_surface(of.look, part, names, "COVERAGE") for part in parts]
    target = Target(tuple(PLANES[name] for name in names), number=1)
    # The programs are so cheap that marks would cost more than they save.
    return _data_passes(of, "data", target, draws, image, marks=False)


def surface_passes(of: Structure, images: Sequence[str], layer: Layer | None) -> list[Pass]:
    """Return the passes that draw the G-buffer of all parts that are not blended, or of a layer.

    images : see :func:`surface_images`
    """
    look, draws = of.look, []
    for part in look.parts:
        features = (
            *("EMISSIVE",) * any(part.material.emissive),
            # Every program must write all images of the pass, also for parts with one lobe.
            *("TWO_LOBES",) * ("lobes" in images and not part.material.two_lobes),
            *("SCATTER",) * (of.scattering is not None),
        )
        draws.append(_surface(look, part, images, *features))
    passes = of.maps() if of.refraction else []  # only refracted light has shadows
    target = Target((4,) * len(images))
    if layer:  # two targets alternate, as each layer reads the previous one
        target = replace(target, sampled=True, number=layer.index % 2)
    draws = of.refracted(draws)
    if layer:
        return [*passes, _peeled(of, "surface", target, draws, layer)]
    return passes + _data_passes(of, "surface", target, [draws[p.index] for p in look.unblended])


def _surface(look: Appearance, part: ResolvedPart, images: Sequence[str], *features: str) -> Draw:
    """Return the draw of images of ``shaders/host/gbuffer.frag``."""
    names = (f"{name.upper()}_IMAGE {index}" for index, name in enumerate(images))
    all_features = *surface_features(part, look.shading), *features, *names
    program = Program("gbuffer.frag", features=all_features)
    return Draw.of_part(program, part, part=part.index + 1)


def fraction_passes(of: Structure, layer: Layer | None) -> list[Pass]:
    """Return the passes that draw the visible fraction of each light that casts shadows, in the
    order of ``Lighting.lights``: of all parts that are not blended and of the parts ``of.cut``,
    which cast no shadows; or of a layer."""
    look, draws = of.look, []
    lighting, name, target = look.lighting, "light_visibility", Target((4,) * (MOST // 4))
    for part in look.parts if layer else (*look.unblended, *of.cut):
        features = surface_features(part, look.shading) + shadow_features(lighting)
        program = Program(f"{name}.frag", features=features, lights=lighting.groups)
        draws.append(Draw.of_part(program, part))
    one = [_peeled(of, name, target, draws, layer)] if layer else []
    *passes, data = one or _data_passes(of, name, target, draws)
    used = tuple(range(-(-len(lighting.shadowed) // 4)))  # four lights in an image
    return [*shadow_passes(look, of.mesh, of.texels), *passes, replace(data, results=used)]


def _data_passes(
    of: Structure,
    name: str,
    target: Target,
    draws: Sequence[Draw],
    image: bool = False,
    marks: bool = True,
) -> list[Pass]:
    """Return passes that draw data of the parts that are not blended and of ``of.cut``.

    draws : one for each of these parts
    marks : whether deferred draws have marks; see :meth:`Structure.deferred`
    """
    results, parts = tuple(range(len(target.channels))), (*of.look.unblended, *of.cut)
    if not of.defers_data:
        ordered = sorted(zip(parts, draws, strict=True), key=lambda pair: pair[0].index)
        forward = tuple(draw for _, draw in ordered)
        return [Pass(name, target, forward, uniforms=of.shared, results=results)]
    deferred = of.deferred(parts, draws, 1, marks)
    passes = [Pass(name, target, deferred, uniforms=of.shared, results=results)]
    shared = image and of.defers(1) and (of.samples == 1 or of.scattering is not None)
    if further := numbered(parts)[len(of.look.unblended) if shared else 0 :]:
        visible = visible_pass(further, 1)
        passes.insert(0, replace(visible, clear=None) if shared else visible)
    return passes


def _peeled(of: Structure, name: str, target: Target, draws: Sequence[Draw], layer: Layer) -> Pass:
    """Return the pass that draws a layer.

    draws : one for each part
    """
    draw = draws[layer.part]
    program = draw.program.having(*("DEPTH_PEELING",) * (layer.index > 0))
    hides = tuple(depth_only(draws[part.index]) for part in of.look.unblended)
    peeled = (*hides, replace(draw, program=program, order="sorted"))
    results = tuple(range(len(target.channels)))
    return Pass(name, target, peeled, uniforms=of.shared, results=results)


def triangle_pass(parts: Iterable[ResolvedPart], shading: Shading) -> Pass:
    """Return the pass that draws the visible triangle at the centre of each pixel: the index of the
    part plus 1, and two channels with the index of the triangle in drawing order.

    parts : parts that are not blended, by index
    """
    draws = []
    for part in parts:
        features = mask_features(surface_features(part, shading))
        program = Program("depth.frag", features=(*features, f"TRIANGLE {INDEX_BASE}"))
        order: Order | None = "facing" if part.material.double_sided is False else None
        draws.append(replace(Draw.of_part(program, part, part=part.index + 1), order=order))
    return Pass("triangles", Target(), tuple(draws), results=(0,))
