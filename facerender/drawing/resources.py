"""The cache of GPU objects (programs, framebuffers, geometry, textures), which also draws a pass
with these objects."""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import prod
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender.drawing.context import Context
from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.prepare import ResolvedPart
from facerender.drawing.program import (
    IN_ROW,
    Program,
    fixed_attributes,
    table_attributes,
    table_features,
    table_texels,
)
from facerender.errors import ContextError, InputError
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Part
from facerender.mesh.setup import Area, TriangleSetup
from facerender.system.process import give_back, unload
from facerender.texture.mips import Kind
from facerender.texture.texture import Texture, Wrap

if TYPE_CHECKING:
    from facerender.scene.environment import Panorama

# Largest number of cached programs, unless one frame needs more.
MOST_PROGRAMS = 64
_STEP = 64  # pixels by which a target grows

_TEXTURE_2D = 0x0DE1
_FRAMEBUFFER, _DEPTH_ATTACHMENT, _RENDERBUFFER = 0x8D40, 0x8D00, 0x8D41
_WRAP_AXES = (0x2802, 0x2803)
_WRAPS: dict[Wrap, int] = {"repeat": 0x2901, "clamp": 0x812F, "mirror": 0x8370}
# SAMPLE_ALPHA_TO_COVERAGE and SAMPLE_ALPHA_TO_ONE, for draws with the feature TO_COVERAGE.
_TO_COVERAGE = (0x809E, 0x809F)
# Keyed by kind of mip chain: internal format, components, format, type, type name in moderngl.
_FORMATS: dict[Kind, tuple[int, int, int, int, str]] = {
    "color": (0x8C43, 4, 0x1908, 0x1401, "f1"),  # SRGB8_ALPHA8, RGBA, UNSIGNED_BYTE
    "linear-color": (0x881A, 4, 0x1908, 0x140B, "f2"),  # RGBA16F, RGBA, HALF_FLOAT
    "normal": (0x8058, 4, 0x1908, 0x1401, "f1"),  # RGBA8, RGBA, UNSIGNED_BYTE
    "data": (0x8051, 3, 0x1907, 0x1401, "f1"),  # RGB8, RGB, UNSIGNED_BYTE
}


@dataclass(eq=False)
class Uploaded:
    """A part on the GPU, which all its poses share.

    setup : vertices of the pose that the GPU holds
    moving : positions and normals, which change with the pose
    fixed : interleaved further vertex attributes, with the widths by name; None if there are none
    chosen : vertex indices of the triangles that a draw chooses; None before its first use
    arrays : cache of vertex arrays, keyed by program and whether they read `chosen`
    table : triangle table of the pose; None before its first use
    selected : texture of the last chosen triangles; None before its first use
    """

    setup: TriangleSetup
    moving: moderngl.Buffer
    fixed: moderngl.Buffer | None
    widths: Mapping[str, int]
    indices: moderngl.Buffer
    chosen: moderngl.Buffer | None = None
    arrays: dict[tuple[moderngl.Program, bool], moderngl.VertexArray] = field(default_factory=dict)
    table: TriangleTable | None = None
    selected: moderngl.Texture | None = None

    @classmethod
    def of(cls, gl: moderngl.Context, part: Part, setup: TriangleSetup) -> Uploaded:
        """Upload a part."""
        moving, fixed = gl.buffer(setup.vertices, dynamic=True), None
        if columns := fixed_attributes(part):
            rows = np.hstack(list(columns.values()), dtype=np.float32, casting="same_kind")
            fixed = gl.buffer(rows)
        widths = {name: column.shape[1] for name, column in columns.items()}
        return cls(setup, moving, fixed, widths, gl.buffer(setup.faces))

    def draw(
        self, gl: moderngl.Context, program: moderngl.Program, order: NDArray[np.int64] | None
    ) -> None:
        """Draw all triangles with a program, or the triangles of an order; see :class:`Draw`."""
        if order is None:
            self.array(gl, program).render()
            return
        if self.chosen is None:
            self.chosen = gl.buffer(reserve=self.indices.size, dynamic=True)
        self.chosen.write(np.take(self.setup.faces, order, axis=0))
        self.array(gl, program, self.chosen).render(vertices=3 * len(order))

    def array(
        self, gl: moderngl.Context, program: moderngl.Program, chosen: moderngl.Buffer | None = None
    ) -> moderngl.VertexArray:
        """Return the vertex array that a program reads, from the cache."""
        key = program, chosen is not None
        if key in self.arrays:
            return self.arrays[key]
        content = []
        moving = {"in_position": 3, "in_normal": 3}
        for buffer, widths in ((self.moving, moving), (self.fixed, self.widths)):
            if used := [name for name in widths if name in program]:
                parts = (f"{n}f" if name in used else f"{n}x4" for name, n in widths.items())
                content.append((buffer, " ".join(parts), *used))
        self.arrays[key] = gl.vertex_array(program, content, chosen or self.indices)
        return self.arrays[key]


@dataclass(eq=False)
class TriangleTable:
    """The triangle table of a part, which ``shaders/host/triangle_table.frag`` draws.

    setup : vertices of the pose that the table holds; None for an empty table
    inputs : textures that the shader reads: "vertices", "attributes" and "faces"
    target : framebuffer with the table as its image, IN_ROW triangles in a row
    """

    setup: TriangleSetup | None
    inputs: Mapping[str, moderngl.Texture]
    target: moderngl.Framebuffer

    @classmethod
    def of(cls, gl: moderngl.Context, part: Part) -> TriangleTable:
        """Return an empty table of a part."""
        attributes = table_attributes(part)
        inputs = {
            "vertices": _empty(gl, len(part.positions), 2, 3),
            "attributes": _empty(gl, len(part.positions), attributes.shape[1], 3),
            "faces": _empty(gl, len(part.faces), 1, 3, "i4"),
        }
        _fill(inputs["attributes"], attributes)
        _fill(inputs["faces"], np.asarray(part.faces, dtype=np.int32))
        table = _empty(gl, len(part.faces), table_texels(part), 4)
        return cls(None, inputs, gl.framebuffer([table]))


def _empty(
    gl: moderngl.Context, count: int, texels: int, components: int, dtype: str = "f4"
) -> moderngl.Texture:
    """Return a texture for `count` items of several texels, IN_ROW items in a row."""
    texture = gl.texture((IN_ROW * texels, -(-count // IN_ROW)), components, dtype=dtype)
    texture.filter = moderngl.NEAREST, moderngl.NEAREST
    return texture


def _fill(texture: moderngl.Texture, values: NDArray[Any]) -> None:
    """Write items (N, ...) to the first texels of a texture, row by row."""
    values = np.ascontiguousarray(values).reshape(len(values), -1)
    width = values.shape[1] // texture.components
    full_rows = len(values) // IN_ROW
    for first_row, rows, columns in (
        (0, full_rows, IN_ROW),
        (full_rows, 1, len(values) - full_rows * IN_ROW),
    ):
        if rows and columns:
            block = values[first_row * IN_ROW : first_row * IN_ROW + rows * columns]
            texture.write(block, (0, first_row, columns * width, rows))


class Resources:
    """Cache of the GPU objects of one context, for frames of one size."""

    def __init__(self, context: Context, size: tuple[int, int], anisotropy: float = 1.0) -> None:
        self.context, self.size, self.anisotropy = context, size, anisotropy
        self.parts: WeakKeyDictionary[Part, Uploaded] = WeakKeyDictionary()
        self.panoramas: WeakKeyDictionary[Panorama, moderngl.Texture] = WeakKeyDictionary()
        self.textures: WeakKeyDictionary[Texture, dict[Kind, moderngl.Texture]] = (
            WeakKeyDictionary()
        )
        self.programs: dict[Program, moderngl.Program] = {}  # least recently used first
        self._frame_programs: set[Program] = set()  # programs of the last frame
        self.targets: dict[Target, moderngl.Framebuffer] = {}
        # moderngl 5.13 does not free a scope completely, so each target reuses one scope.
        self.scopes: dict[Target, moderngl.Scope] = {}
        self.images_held: dict[Target, Hashable] = {}  # Pass.key of the image in each target
        self.screen_arrays: dict[moderngl.Program, moderngl.VertexArray] = {}
        self._settled = True

    def release(self) -> None:
        """Free all GPU objects. The context must be current."""
        textures = self.panoramas, self.textures
        objects = self.parts, self.programs, self.targets, self.scopes, self.screen_arrays
        for cache in (*textures, *objects, self.images_held):
            cache.clear()
        self.context.gl.gc()

    def settle(self) -> None:
        """Free dropped objects, and unused programs beyond MOST_PROGRAMS. Return freed memory to
        the system. The renderer calls this method before each frame.

        malloc keeps the memory that decoders, uploads and compilers freed (110 MiB for the built-in
        head). After a frame that created GPU objects, this memory is released, and so are the
        pages of mip chains in mapped files. The context must be current.
        """
        unused = [source for source in self.programs if source not in self._frame_programs]
        for source in unused[: max(len(self.programs) - MOST_PROGRAMS, 0)]:
            program = self.programs.pop(source)
            self.screen_arrays.pop(program, None)
            for part in self.parts.values():
                part.arrays = {key: part.arrays[key] for key in part.arrays if key[0] != program}
        self._frame_programs.clear()
        self.context.gl.gc()
        if not self._settled:
            for texture, uploaded in self.textures.items():
                for kind in uploaded if not texture.coarse else ():
                    unload(texture.levels(kind).result())
            give_back()
        self._settled = True

    def draw(
        self, step: Pass, mesh: Mesh, textures: Mapping[str, moderngl.Texture]
    ) -> moderngl.Framebuffer:
        """Draw a pass into its target, and return the target. Raises InputError if a map is damaged
        or too large, and ContextError if the driver refuses a target or a program.

        textures : keyed by uniform name, such as the images of earlier passes
        """
        target = self.target(step.target, step.area)
        key = self.images_held.pop(step.target, None)
        if step.key is not None and key == step.key:
            self.images_held[step.target] = key
            return target
        for draw in step.draws:
            if draw.depth == "marked" and draw.part is not None:
                self._draw_table(draw.part, mesh)
        with self.scopes[step.target]:
            self._prepare(target, step)  # an error in an earlier draw may have left another state
            target.depth_mask = step.target.depth_of is None
            target.clear(*step.clear, viewport=step.area)
            gl = self.context.gl
            for draw in step.draws:
                self._prepare(target, step, draw)
                masks = _TO_COVERAGE * ("TO_COVERAGE" in " ".join(draw.program.features))
                for capability in masks:
                    gl.enable_direct(capability)
                try:
                    self._draw(draw, step, mesh, textures)
                finally:
                    for capability in masks:
                        gl.disable_direct(capability)
        self.images_held[step.target] = step.key
        return target

    def _prepare(self, target: moderngl.Framebuffer, step: Pass, draw: Draw | None = None) -> None:
        """Set write masks, viewport, depth test, blending and culling for a draw, or for a clear if
        `draw` is None."""
        gl, depth = self.context.gl, draw.depth if draw else "test"
        colors, count = (depth not in ("mark", "hide"),) * 4, len(target.color_attachments)
        target.color_mask = colors if count == 1 else [colors] * count  # type: ignore[assignment]
        target.depth_mask = depth not in ("marked", "blend")
        target.viewport = (draw and draw.area) or (0, 0, *(step.target.size or self.size))
        target.use()  # applies the masks and the viewport
        gl.depth_func = {"mark": "1", "marked": "=="}.get(depth, "<=")
        if draw is None:
            return
        blended = depth == "blend"
        enabled = moderngl.DEPTH_TEST | moderngl.BLEND * (step.added or blended)
        gl.enable_only(enabled | moderngl.CULL_FACE * (draw.double_sided is False))
        gl.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA if blended else moderngl.ONE
        gl.cull_face = "front"  # the image is drawn upside down, so front and back swap

    def _draw(
        self, draw: Draw, step: Pass, mesh: Mesh, textures: Mapping[str, moderngl.Texture]
    ) -> None:
        program = self.program(draw.program)
        set_uniforms(program, {**step.uniforms, **draw.uniforms})
        uploaded = self.part(draw.part, mesh) if draw.part else None
        self.bind(program, draw, textures)
        if uploaded is None or draw.depth == "marked":
            self._screen(program).render(vertices=3)
        else:
            uploaded.draw(self.context.gl, program, draw.order)

    def bind(
        self, program: moderngl.Program, draw: Draw, textures: Mapping[str, moderngl.Texture]
    ) -> None:
        """Bind the material's maps, the triangle table and the scene's textures to the uniforms of
        a program."""
        textures = dict(textures)
        if (part := draw.part) is not None:
            for map_ in part.maps:
                if program.get(map_[0], None):
                    textures[map_[0]] = self.texture(*map_)  # uploads bind unit 0
            uploaded = self.parts[part.part]
            if draw.depth == "marked":
                assert uploaded.table
                (table,) = uploaded.table.target.color_attachments
                textures["triangle_table"] = table  # type: ignore[assignment]
            if draw.order is not None and program.get("selected_triangles", None):
                if uploaded.selected is None:
                    uploaded.selected = _empty(self.context.gl, len(part.part.faces), 1, 1)
                textures["selected_triangles"] = uploaded.selected
                _fill(uploaded.selected, draw.order.astype(np.float32))
        _use(program, textures)

    def take_coarse(self, parts: Sequence[ResolvedPart]) -> None:
        """Decode and upload the reduced maps of parts (``Texture.coarse``), one after another.

        To limit peak memory, the renderer calls this method before it allocates targets and
        programs, and the maps whose decoding needs most memory come first. Among equal kinds the
        smallest maps come first, because an image is decoded again for each part that uses it.
        """
        maps = dict.fromkeys(map_ for part in parts for map_ in part.maps if map_[1].coarse)
        if not maps:
            return
        costs = ("normal", "color", "data")
        with self.context.drawing() as gl:
            gl.gc()
            for map_ in sorted(maps, key=lambda map_: (costs.index(map_[2]), prod(map_[1].size))):
                self.texture(*map_)

    def target(self, kind: Target, area: Area | None = None) -> moderngl.Framebuffer:
        """Return the framebuffer of a target, created on first use.

        area : pixels that a pass draws. A target that shares a depth buffer is only as large as its
            passes need, because the images of several samples are large
        """
        gl, size = self.context.gl, kind.size or self.size
        if kind.depth_of is not None and area is not None:
            minimum = self.targets[kind].size if kind in self.targets else (0, 0)
            right, top = (-(-(area[i] + area[i + 2]) // _STEP) * _STEP for i in (0, 1))
            size = min(size[0], max(right, minimum[0])), min(size[1], max(top, minimum[1]))
            if size != minimum:
                self.targets.pop(kind, None)
                gl.gc()
        if kind in self.targets:
            return self.targets[kind]
        self._settled = False
        samples = kind.samples if kind.samples > 1 else 0
        try:
            components = 1 if kind.values == "number" else 4
            resolved = samples and kind.values == "color" and kind.resolved
            make = gl.texture if kind.sampled and not resolved else gl.renderbuffer
            colors: list[Any] = [
                make(size, components, samples=samples, dtype="f4") for _ in range(kind.colors)
            ]
            if kind.sampled and not samples:
                for color in colors:
                    color.filter = moderngl.NEAREST, moderngl.NEAREST
            if kind.depth_of is None:
                target = gl.framebuffer(colors, gl.depth_renderbuffer(size, samples=samples))
            else:  # moderngl refuses the depth buffer of a larger framebuffer
                depth: Any = self.target(kind.depth_of).depth_attachment
                attach = self.context.function("glFramebufferRenderbuffer", *[ctypes.c_uint] * 4)
                target = gl.framebuffer(colors)
                target.use()
                attach(_FRAMEBUFFER, _DEPTH_ATTACHMENT, _RENDERBUFFER, depth.glo)
            self.targets[kind], self.scopes[kind] = target, gl.scope(target)
        except moderngl.Error as error:
            raise ContextError(
                f"{self.context.renderer} cannot draw {size[0]} x {size[1]} pixels with "
                f"{kind.samples} samples ({error}); lower the size or the samples"
            ) from None
        return target

    def program(self, source: Program) -> moderngl.Program:
        """Return the compiled program from the cache, or compile it. The cache is limited by
        :meth:`settle`."""
        self._frame_programs.add(source)
        if source in self.programs:
            self.programs[source] = self.programs.pop(source)
        else:
            self._settled = False
            stages = source.sources("330 core")
            try:
                self.programs[source] = self.context.gl.program(
                    vertex_shader=stages["vert"], fragment_shader=stages["frag"]
                )
            except moderngl.Error as error:
                raise ContextError(
                    f"{self.context.renderer} cannot compile a program: {error}"
                ) from None
        return self.programs[source]

    def part(self, part: ResolvedPart, mesh: Mesh) -> Uploaded:
        """Return a part on the GPU, which is uploaded on first use. Positions and normals are
        uploaded again if the pose, or the mesh's centre, has changed."""
        setup = mesh.setups[part.index]
        uploaded = self.parts.get(part.part)
        if uploaded is None:
            uploaded = self.parts[part.part] = Uploaded.of(self.context.gl, part.part, setup)
        elif uploaded.setup is not setup:
            uploaded.moving.write(setup.vertices)
            uploaded.setup = setup
        return uploaded

    def _draw_table(self, part: ResolvedPart, mesh: Mesh) -> None:
        """Draw the triangle table of a part, unless it is up to date."""
        gl, uploaded = self.context.gl, self.part(part, mesh)
        if uploaded.table is None:
            self._settled = False
            uploaded.table = TriangleTable.of(gl, part.part)
        table = uploaded.table
        if table.setup is uploaded.setup:
            return
        _fill(table.inputs["vertices"], uploaded.setup.vertices)
        columns = table.inputs["attributes"].width // IN_ROW
        rows = f"VERTICES_IN_ROW {IN_ROW}", f"ATTRIBUTE_TEXELS {columns}"
        macros = *table_features(part.part), *rows
        program = self.program(Program("triangle_table.frag", "screen.vert", macros))
        _use(program, table.inputs)
        table.target.use()
        gl.enable_only(moderngl.NOTHING)
        self._screen(program).render(vertices=3)
        table.setup = uploaded.setup

    def _screen(self, program: moderngl.Program) -> moderngl.VertexArray:
        """Return the vertex array of a program that draws one triangle over the target."""
        if program not in self.screen_arrays:
            self.screen_arrays[program] = self.context.gl.vertex_array(program, [])
        return self.screen_arrays[program]

    def panorama(self, source: Panorama) -> moderngl.Texture:
        """Return the texture of a panorama, which is uploaded on first use."""
        if source not in self.panoramas:
            self._settled = False
            height, width, components = source.map.shape
            texture = self.context.gl.texture((width, height), components, source.map, dtype="f4")
            texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self.panoramas[source] = texture
        return self.panoramas[source]

    def texture(self, name: str, source: Texture, kind: Kind) -> moderngl.Texture:
        """Return the texture of a map, whose mip chain is uploaded on first use.

        All mip levels come from texture.py: moderngl's build_mipmaps takes 65 ms for 2048 x 2048
        texels on a software driver.
        """
        uploaded = self.textures.setdefault(source, {})
        if kind in uploaded:
            return uploaded[kind]
        self._settled = False
        levels = source.levels(kind).result()
        if source.coarse:
            give_back()  # the images that the mip chain was made of
        gl = self.context.gl
        internal, components, layout, data_type, dtype = _FORMATS[kind]
        height, width = levels[0].shape[:2]
        limit = gl.info["GL_MAX_TEXTURE_SIZE"]
        if max(width, height) > limit:
            raise InputError(
                f"{source.name} is {width} x {height} texels: this driver allows at most {limit} a "
                "side; give a smaller map"
            )
        first_texel = levels[0][:1, :1].copy()  # sets the unpack alignment to 1 for all levels
        texture = gl.texture((1, 1), components, first_texel, 0, 1, dtype, internal_format=internal)
        texture.use(0)
        self._reserve(internal, [level.shape for level in levels], layout, data_type)
        upload = self.context.function("glTexSubImage2D", *[ctypes.c_int] * 8, ctypes.c_void_p)
        for number, level in enumerate(levels):
            texels = np.ascontiguousarray(level)
            place = 0, 0, level.shape[1], level.shape[0]
            upload(_TEXTURE_2D, number, *place, layout, data_type, texels.ctypes.data)
        # The values of a property map vary slowly, so a step between mip levels is invisible.
        # Blending two levels would take 5 % of the frame time on a software driver.
        step = name == "property_map"
        smaller = moderngl.LINEAR_MIPMAP_NEAREST if step else moderngl.LINEAR_MIPMAP_LINEAR
        if len(levels) == 1:
            smaller = moderngl.LINEAR
        texture.filter = smaller, moderngl.LINEAR
        texture.anisotropy = self.anisotropy
        if source.nearest:
            texture.filter = moderngl.NEAREST_MIPMAP_NEAREST, moderngl.NEAREST
            texture.anisotropy = 1.0
        change = self.context.function("glTexParameteri", *[ctypes.c_uint] * 2, ctypes.c_int)
        for axis, wrap in zip(_WRAP_AXES, source.wrap, strict=True):
            change(_TEXTURE_2D, axis, _WRAPS[wrap])
        uploaded[kind] = texture
        if source.coarse:
            del levels
            source.forget()
            give_back()
        return texture

    def _reserve(
        self, internal: int, shapes: Sequence[tuple[int, ...]], layout: int, data_type: int
    ) -> None:
        """Allocate all mip levels of the bound texture, with glTexStorage2D if the driver has it.
        After glTexImage2D, Mesa holds the finest level twice until the texture is drawn."""
        (height, width, *_), count = shapes[0], len(shapes)
        if self.context.loader.load("glTexStorage2D"):  # OpenGL 4.2, or ARB_texture_storage
            store = self.context.function("glTexStorage2D", *[ctypes.c_int] * 5)
            store(_TEXTURE_2D, count, internal, width, height)
            return
        image = self.context.function("glTexImage2D", *[ctypes.c_int] * 8, ctypes.c_void_p)
        for number, (height, width, *_) in enumerate(shapes):
            image(_TEXTURE_2D, number, internal, width, height, 0, layout, data_type, None)


def read(target: moderngl.Framebuffer, attachment: int = 0) -> NDArray[np.float32]:
    """Return the pixels (H, W, 4) of a target that has no multisampling."""
    pixels = np.empty((target.height, target.width, 4), dtype=np.float32)
    target.read_into(pixels, components=4, attachment=attachment, dtype="f4")
    return pixels


def _use(program: moderngl.Program, textures: Mapping[str, moderngl.Texture]) -> None:
    """Bind textures to the uniforms that the compiler has not removed from a program."""
    used = [binding for binding in textures.items() if program.get(binding[0], None)]
    for unit, (name, texture) in enumerate(used):
        texture.use(unit)
        program[name].value = unit  # type: ignore[union-attr]


def set_uniforms(program: moderngl.Program, values: Mapping[str, Any]) -> None:
    """Set the uniforms that the compiler has not removed from a program."""
    for name, value in values.items():
        uniform: Any = program.get(name, None)  # `name in program` compares name by name
        if uniform is None:
            continue
        if isinstance(value, np.ndarray):
            # The compiler shortens an array if the program does not read the last elements.
            size = uniform.array_length * uniform.element_size
            uniform.write(value.astype(np.float32).tobytes()[:size])
        else:
            uniform.value = value


def free(resources: Resources) -> None:
    """Free the GPU objects of a renderer and its context."""
    with resources.context.drawing():
        resources.release()
    resources.context.release()


def free_dropped(resources: Resources) -> None:
    """Free the GPU objects of a renderer that was garbage-collected without release.

    If the context belongs to the host and is not current, the objects remain until the host frees
    the context.
    """
    if resources.context.released or resources.context.inherited:
        return
    warnings.warn(
        "a Renderer was dropped without release(): create it in a with statement",
        ResourceWarning,
        stacklevel=2,
    )
    with suppress(ContextError):
        free(resources)
