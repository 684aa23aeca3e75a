"""Scene and Shading to Frame: uploads a mesh once, compiles only what the scene needs, draws, and
reads linear float32 back. The one module that calls OpenGL, apart from ``context``."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender._version import __version__
from facerender.brdf import Fresnel, Masking
from facerender.drawing.context import Backend, create_context
from facerender.drawing.frame import ONLY, Frame, GBuffer, Only
from facerender.drawing.prepare import part_maps, start_maps
from facerender.drawing.reference import data_view
from facerender.errors import ContextError, InputError
from facerender.glsl.library import resolve_includes
from facerender.loading import load_mesh
from facerender.lobes import AnyLobe
from facerender.scenes.camera import Camera
from facerender.scenes.light import Light
from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.scene import Scene, point_lights, slope_ranges
from facerender.scenes.texture import Kind, Texture
from facerender.scenes.view import View, view_of
from facerender.shading import Model, Outside, Shading

MAX_SIZE = 16384

_TEXTURE_2D = 0x0DE1
_SRGB8_ALPHA8 = 0x8C43
_RGB8 = 0x8051
_RGBA16F = 0x881A
_RGB, _RGBA = 0x1907, 0x1908
_UNSIGNED_BYTE, _HALF_FLOAT = 0x1401, 0x140B
# kind of mip chain: (internal format, components, format, type, moderngl's name of the type)
_FORMATS: dict[Kind, tuple[int, int, int, int, str]] = {
    "color": (_SRGB8_ALPHA8, 4, _RGBA, _UNSIGNED_BYTE, "f1"),
    "linear-color": (_RGBA16F, 4, _RGBA, _HALF_FLOAT, "f2"),
    "data": (_RGB8, 3, _RGB, _UNSIGNED_BYTE, "f1"),
}


@dataclass(frozen=True, eq=False)
class _GpuPart:
    """A part's geometry on the GPU: attributes, interleaved, the width of each, and indices."""

    vertices: moderngl.Buffer
    attributes: Mapping[str, int]
    indices: moderngl.Buffer
    arrays: dict[moderngl.Program, moderngl.VertexArray]


class Renderer:
    """Draws scenes. Meshes, programs and framebuffers are kept for the next frame.

    Use it as a context manager, or call :meth:`release`. One renderer serves one thread at a time.

    Parameters
    ----------
    size : width and height in pixels, each in [1, 16384]
    samples : per pixel; 1 for none, or what the driver offers (4 on Mesa's software driver)
    backend : "auto", "egl", "osmesa", or "current" for the host's context
    anisotropy : of texture filtering, 1 to 16; 8 nearly doubles a frame on a software driver
    float_albedo : keep albedo maps as linear float16 in place of 8-bit sRGB, so that drivers agree
        to the last digits

    Raises
    ------
    InputError : a value outside its domain
    ContextError : no OpenGL context, or one without the samples or the size asked for
    """

    def __init__(
        self,
        size: tuple[int, int] = (1024, 1024),
        *,
        samples: int = 4,
        backend: Backend = "auto",
        anisotropy: float = 1.0,
        float_albedo: bool = False,
    ) -> None:
        width, height = size
        if not (1 <= width <= MAX_SIZE and 1 <= height <= MAX_SIZE):
            raise InputError(f"size {width} x {height}: give 1 to {MAX_SIZE} pixels a side")
        if samples < 1:
            raise InputError(f"samples = {samples}: give 1 or more")
        if not 1.0 <= anisotropy <= 16.0:
            raise InputError(f"anisotropy = {anisotropy:g} is outside [1, 16]")
        self.size = (width, height)
        self.samples = samples
        self.anisotropy = anisotropy
        self.albedo_kind: Kind = "linear-color" if float_albedo else "color"
        self.context = create_context(backend)
        self._parts: WeakKeyDictionary[Part, _GpuPart] = WeakKeyDictionary()
        self._textures: WeakKeyDictionary[Texture, moderngl.Texture] = WeakKeyDictionary()
        self._programs: dict[str, moderngl.Program] = {}
        self._targets: dict[str, moderngl.Framebuffer] = {}
        try:
            with self.context.drawing():
                self._check_limits()
        except ContextError:
            self.release()
            raise

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.release()

    def release(self) -> None:
        """Free everything on the GPU, and the context unless it is the host's; a second time does
        nothing."""
        if self.context.released:
            return
        with self.context.drawing() as gl:
            for cache in (self._parts, self._textures, self._programs, self._targets):
                cache.clear()
            gl.gc()
        self.context.release()

    @property
    def metadata(self) -> dict[str, str]:
        """Where images come from; a frame adds what it was shaded with."""
        return {
            "facerender": __version__,
            "GL_RENDERER": self.context.renderer,
            "GL_VERSION": self.context.version,
            "samples": str(self.samples),
            "albedo": "RGBA16F" if self.albedo_kind == "linear-color" else "SRGB8_ALPHA8",
        }

    def render(self, scene: Scene, shading: Shading = Shading(), only: Only | None = None) -> Frame:
        """Draw a scene.

        Parameters
        ----------
        only : one term in place of the whole image; normal, albedo, depth and cosines have one
            sample a pixel

        Raises
        ------
        InputError : a map is damaged, m lies outside the lobe's domain and the shading asks for an
            error then, an unknown term
        """
        if only in ("normal", "albedo", "depth", "cosines"):
            linear = data_view(self.gbuffer(scene, shading), scene, only)
            metadata = {**self.metadata, "samples": "1"}
            return Frame(linear, only, scene.background is None, metadata)
        if only not in (None, "specular", "diffuse"):
            raise InputError(f"unknown term {only!r}; known: {', '.join(ONLY)}")
        scene = shading.simplify(scene)
        lights = _by_kind(scene, shading)
        scene = replace(scene, lights=tuple(light for kind in lights for light in kind))
        mesh = scene.mesh
        start_maps(mesh, self.albedo_kind)
        ranges = [] if only == "diffuse" else slope_ranges(scene)
        chosen = [shading.for_slopes(*ends) for ends in ranges]
        specular = [choice.glsl(ends[0]) for choice, ends in zip(chosen, ranges, strict=True)]
        view = view_of(scene, self.size[0] / self.size[1])
        with self.context.drawing() as gl:
            target = self._target("multisample" if self.samples > 1 else "single")
            with gl.scope(target, enable_only=moderngl.DEPTH_TEST):
                target.clear(*_clear_color(scene, only))
                for number, part in enumerate(mesh.parts):
                    material = mesh.materials[number]
                    brdf = specular[number] if specular else ""
                    defines = _shade_defines(part, material, scene, lights, brdf, only)
                    self._draw(part, material, self._program("shade", defines), view, scene)
            if self.samples > 1:
                single = self._target("single")
                gl.copy_framebuffer(single, target)
                target = single
            metadata = {
                **self.metadata,
                "model": shading.model,
                "lobe": str(shading.lobe),
                "fresnel": shading.fresnel,
                "masking": shading.masking,
            }
            left_out = {key: str(value) for key, value in shading.as_dict().items()}
            metadata = left_out | metadata
            if any(choice is not shading for choice in chosen):
                metadata["lobe of each part"] = ", ".join(str(choice.lobe) for choice in chosen)
            return Frame(self._read(target), only, scene.background is None, metadata)

    def gbuffer(self, scene: Scene, shading: Shading = Shading()) -> GBuffer:
        """Draw what shading reads at each pixel's centre; errors as in :meth:`render`."""
        scene = shading.simplify(scene)
        mesh = scene.mesh
        start_maps(mesh, self.albedo_kind)
        view = view_of(scene, self.size[0] / self.size[1])
        with self.context.drawing() as gl:
            target = self._target("gbuffer")
            with gl.scope(target, enable_only=moderngl.DEPTH_TEST):
                target.clear()
                for number, part in enumerate(mesh.parts):
                    material = mesh.materials[number]
                    program = self._program("gbuffer", _surface_defines(part, material))
                    _set(program, "part", number + 1.0)
                    self._draw(part, material, program, view, scene)
            position, normal, albedo, uv = (self._read(target, index) for index in range(4))
        return GBuffer(
            part=position[..., 3].astype(np.int64) - 1,
            position=position[..., :3],
            normal=normal[..., :3],
            albedo=albedo[..., :3],
            m=normal[..., 3],
            specular_weight=albedo[..., 3],
            occlusion=uv[..., 2],
            uv=uv[..., :2],
            view=view,
        )

    # --- OpenGL ----------------------------------------------------------------------------------

    def _check_limits(self) -> None:
        limits = self.context.gl.info
        most = min(limits["GL_MAX_TEXTURE_SIZE"], *limits["GL_MAX_VIEWPORT_DIMS"])
        if max(self.size) > most:
            raise ContextError(
                f"size {self.size[0]} x {self.size[1]}: {self.context.renderer} draws at most "
                f"{most} pixels a side"
            )
        if self.samples > 1 and self.samples > self.context.gl.max_samples:
            raise ContextError(
                f"samples = {self.samples}: {self.context.renderer} offers at most "
                f"{self.context.gl.max_samples}"
            )

    def _read(self, target: moderngl.Framebuffer, attachment: int = 0) -> NDArray[np.float32]:
        pixels = np.empty((self.size[1], self.size[0], 4), dtype=np.float32)
        target.read_into(pixels, components=4, attachment=attachment, dtype="f4")
        return pixels

    def _target(self, kind: str) -> moderngl.Framebuffer:
        if kind not in self._targets:
            gl = self.context.gl
            samples = self.samples if kind == "multisample" else 0
            count = 4 if kind == "gbuffer" else 1
            try:
                colors = [gl.renderbuffer(self.size, 4, samples, dtype="f4") for _ in range(count)]
                depth = gl.depth_renderbuffer(self.size, samples=samples)
                self._targets[kind] = gl.framebuffer(colors, depth)
            except moderngl.Error as error:
                raise ContextError(
                    f"{self.context.renderer} cannot draw {self.size[0]} x {self.size[1]} pixels "
                    f"with {max(samples, 1)} samples ({error}); lower one of them"
                ) from None
        return self._targets[kind]

    def _program(self, name: str, prelude: str) -> moderngl.Program:
        """Compile vertex and fragment program with the prelude's defines, once for each prelude."""
        key = name + prelude
        if key not in self._programs:
            head = "#version 330 core\n" + prelude
            try:
                self._programs[key] = self.context.gl.program(
                    vertex_shader=resolve_includes(head + '#include "host/surface.vert"\n'),
                    fragment_shader=resolve_includes(head + f'#include "host/{name}.frag"\n'),
                )
            except moderngl.Error as error:
                raise ContextError(f"{self.context.renderer} refused a program: {error}") from None
        return self._programs[key]

    def _upload(self, part: Part, mesh: Mesh) -> _GpuPart:
        if part not in self._parts:
            gl = self.context.gl
            gl.gc()
            columns = {"in_position": mesh.normalised(part.positions), "in_normal": part.normals}
            if part.uv is not None:
                columns["in_uv"] = part.uv
            if part.colors is not None:
                columns["in_color"] = part.colors
            vertices = np.hstack(list(columns.values()), dtype=np.float32, casting="same_kind")
            attributes = {name: values.shape[1] for name, values in columns.items()}
            self._parts[part] = _GpuPart(gl.buffer(vertices), attributes, gl.buffer(part.faces), {})
        return self._parts[part]

    def _texture(self, name: str, source: Texture, kind: Kind) -> moderngl.Texture:
        """Upload a mip chain. moderngl uploads level 0; its build_mipmaps would take 65 ms for
        2048 x 2048 texels on a software driver, the chain from texture.py is there already."""
        if source in self._textures:
            return self._textures[source]
        levels = source.levels(kind).result()
        gl = self.context.gl
        internal, components, layout, data_type, dtype = _FORMATS[kind]
        height, width = levels[0].shape[:2]
        limit = gl.info["GL_MAX_TEXTURE_SIZE"]
        if max(width, height) > limit:
            raise InputError(f"{source.name} is {width} x {height} texels: at most {limit} here")
        size = (width, height)
        texture = gl.texture(size, components, levels[0], 0, 1, dtype, internal_format=internal)
        upload = self.context.function(
            "glTexImage2D", *[ctypes.c_int] * 6, ctypes.c_uint, ctypes.c_uint, ctypes.c_void_p
        )
        texture.use(0)  # level 0 went up with an alignment of 1, which stays
        for number, level in enumerate(levels[1:], start=1):
            texels = np.ascontiguousarray(level)
            extent = level.shape[1], level.shape[0], 0
            texel_format = layout, data_type
            upload(_TEXTURE_2D, number, internal, *extent, *texel_format, texels.ctypes.data)
        # Properties vary slowly: between two levels nothing is seen of a step, and the second
        # level would take 5 % of a frame on a software driver.
        step = name == "property_map"
        smaller = moderngl.LINEAR_MIPMAP_NEAREST if step else moderngl.LINEAR_MIPMAP_LINEAR
        texture.filter = smaller, moderngl.LINEAR
        texture.anisotropy = self.anisotropy
        self._textures[source] = texture
        return texture

    def _draw(
        self, part: Part, material: Material, program: moderngl.Program, view: View, scene: Scene
    ) -> None:
        for name, value in _uniforms(part, material, view, scene).items():
            _set(program, name, value)
        maps = part_maps(part, material, self.albedo_kind)
        textures = [self._texture(*each) for each in maps]  # before binding: it uses unit 0
        for unit, (texture, (name, _, _)) in enumerate(zip(textures, maps, strict=True)):
            texture.use(unit)
            _set(program, name, unit)
        uploaded = self._upload(part, scene.mesh)
        if program not in uploaded.arrays:
            widths = uploaded.attributes
            layout = " ".join(
                f"{width}f" if name in program else f"{width}x4" for name, width in widths.items()
            )
            used = [name for name in widths if name in program]
            array = self.context.gl.vertex_array(
                program, [(uploaded.vertices, layout, *used)], uploaded.indices
            )
            uploaded.arrays[program] = array
        uploaded.arrays[program].render()


def _set(program: moderngl.Program, name: str, value: Any) -> None:
    """Set a uniform, unless the compiler found that it does not count."""
    if name not in program:
        return
    uniform: Any = program[name]
    if isinstance(value, np.ndarray):
        # An array that the program does not read to its end is shorter there.
        size = uniform.array_length * uniform.element_size
        uniform.write(value.astype(np.float32).tobytes()[:size])
    else:
        uniform.value = value


def _surface_defines(part: Part, material: Material) -> str:
    names = [name.upper() for name, _, _ in part_maps(part, material, "color")]
    if part.uv is not None:
        names.append("UV")
        for name in ("occlusion_map", "roughness_map", "specular_map"):
            if getattr(material, name) is not None:
                names.append(name.upper())
    if part.colors is not None:
        names.append("VERTEX_COLORS")
    if material.albedo != (1.0, 1.0, 1.0):
        names.append("ALBEDO_FACTOR")
    return "".join(f"#define {name}\n" for name in names)


def _by_kind(scene: Scene, shading: Shading) -> tuple[list[Light], list[Light], list[Light]]:
    """The lights with a whole specular term, with that of frontal light, and without, in the order
    of shade.frag."""
    kinds: tuple[list[Light], list[Light], list[Light]] = ([], [], [])
    for index, light in enumerate(scene.lights):
        kind = int(index in shading.frontal_lights) if shading.shines(index) else 2
        kinds[kind].append(light)
    return kinds


def _shade_defines(
    part: Part,
    material: Material,
    scene: Scene,
    lights: Sequence[Sequence[Light]],
    specular: str,
    only: Only | None,
) -> str:
    lines = [_surface_defines(part, material)]
    for name, points in (("DIRECTIONAL", False), ("POINT", True)):
        whole, frontal, dull = (
            sum((light.position is not None) == points for light in kind) for kind in lights
        )
        lines += [
            f"#define {name}_LIGHTS {whole + frontal + dull}\n",
            f"#define {name}_SPECULAR {whole}\n",
            f"#define {name}_FRONTAL {frontal}\n",
        ]
    if any(scene.ambient):  # type: ignore[arg-type]
        lines.append("#define AMBIENT\n")
    if only != "specular" and material.kd > 0.0:
        lines.append("#define DIFFUSE\n")
    if material.ks > 0.0:
        lines.append(specular)
    return "".join(lines)


def _uniforms(part: Part, material: Material, view: View, scene: Scene) -> dict[str, Any]:
    mapped = part.uv is not None and material.roughness_map is not None
    values: dict[str, Any] = {
        "view_projection": view.matrix,
        "eye": view.eye,
        "albedo_factor": np.asarray(material.albedo),
        "slope": material.roughness_factor**2 if mapped else material.m,
        "specular_weight": material.ks,
        "diffuse_weight": material.kd,
        "f0": material.f0,
        "ambient": np.asarray(scene.ambient),
    }
    distant = [light for light in scene.lights if light.position is None]
    if distant:
        values["light_direction"] = np.array([light.direction for light in distant])
        values["light_irradiance"] = np.array([light.irradiance for light in distant])
    points = point_lights(scene)
    if points:
        values["light_position"] = np.array([position for position, _ in points])
        values["light_intensity"] = np.array([intensity for _, intensity in points])
    return values


def _clear_color(scene: Scene, only: Only | None) -> tuple[float, float, float, float]:
    """The background, with coverage 0."""
    red, green, blue = scene.background if scene.background and only is None else (0.0, 0.0, 0.0)
    return red, green, blue, 0.0


def render(
    mesh: Mesh | str | os.PathLike[str] | None = None,
    *,
    model: Model = "cook-torrance",
    lobe: AnyLobe = "exact",
    fresnel: Fresnel = "schlick",
    masking: Masking = "v-cavity",
    outside: Outside = "error",
    m: float | None = None,
    size: tuple[int, int] = (1024, 1024),
    samples: int = 4,
    backend: Backend = "auto",
    camera: Camera = Camera(),
    lights: tuple[Light, ...] | None = None,
    only: Only | None = None,
) -> Frame:
    """Render one image: a mesh file, a loaded mesh, or the built-in head.

    For several images, or further settings, make a :class:`Renderer`, which keeps what it uploads.

    Parameters
    ----------
    mesh : file, mesh, or None for the built-in head
    model, lobe, fresnel, masking, outside : see :class:`Shading`
    m : rms slope for the whole mesh, in place of its roughness map
    size, samples, backend : see :class:`Renderer`
    camera, lights : see :class:`Scene`
    only : see :meth:`Renderer.render`

    Raises
    ------
    InputError : a file or a value cannot be used
    ContextError : no OpenGL context
    """
    shading = Shading(model, lobe, fresnel, outside, masking)
    loaded = mesh if isinstance(mesh, Mesh) else load_mesh(mesh)
    if m is not None:
        loaded = loaded.with_material(m=m)
    start_maps(loaded)
    scene = Scene(loaded, camera) if lights is None else Scene(loaded, camera, lights)
    with Renderer(size, samples=samples, backend=backend) as renderer:
        return renderer.render(scene, shading, only)
