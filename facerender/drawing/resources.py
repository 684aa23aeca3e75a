"""The cache of GPU objects: programs, framebuffers, geometry and textures."""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from math import prod
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender.drawing.context import Context
from facerender.drawing.prepare import Appearance, ResolvedPart
from facerender.drawing.program import (
    IN_ROW,
    TABLE_TEXELS,
    Draw,
    Order,
    Program,
    Target,
    fixed_attributes,
)
from facerender.errors import ContextError, InputError
from facerender.mesh.part import Area, Part, TriangleSetup
from facerender.system.process import give_back, unload
from facerender.texture.texture import Kind, Texture, Wrap
from facerender.values.vectors import Array, Float32, Integers

if TYPE_CHECKING:
    from facerender.scene.environment import Panorama

OF_TABLE = "marked", "visible"  # values of Draw.depth: such draws read a triangle table
# Largest number of cached programs, unless one frame needs more.
MAX_PROGRAMS = 64
_STEP = 64  # pixels by which a target grows

_TEXTURE_2D = 0x0DE1
_FRAMEBUFFER, _DEPTH_ATTACHMENT, _RENDERBUFFER = 0x8D40, 0x8D00, 0x8D41
_WRAP_AXES = (0x2802, 0x2803)
_WRAPS: dict[Wrap, int] = {"repeat": 0x2901, "clamp": 0x812F, "mirror": 0x8370}
# SAMPLER_2D, SAMPLER_2D_MULTISAMPLE and INT_SAMPLER_2D.
_SHARED = "visible", "shadow_map", "shadow_cones", "shadow_tops", "environment_map"
_SAMPLERS = (0x8B5E, 0x9108, 0x8DCA)
# Keyed by kind of mip chain: internal format, components, format, type, type name in moderngl.
_FORMATS: dict[Kind, tuple[int, int, int, int, str]] = {
    "color": (0x8C43, 4, 0x1908, 0x1401, "f1"),  # SRGB8_ALPHA8, RGBA, UNSIGNED_BYTE
    "linear-color": (0x881A, 4, 0x1908, 0x140B, "f2"),  # RGBA16F, RGBA, HALF_FLOAT
    "normal": (0x8058, 4, 0x1908, 0x1401, "f1"),  # RGBA8, RGBA, UNSIGNED_BYTE
    "data": (0x8051, 3, 0x1907, 0x1401, "f1"),  # RGB8, RGB, UNSIGNED_BYTE
}


@dataclass(frozen=True, eq=False)
class CompiledProgram:
    """A program on the GPU.

    uniforms, samplers : uniforms by name that the compiler has not removed
    """

    program: moderngl.Program
    uniforms: Mapping[str, Any]
    samplers: Mapping[str, Any]

    @classmethod
    def of(cls, program: moderngl.Program) -> CompiledProgram:
        """Sort the uniforms of a program."""
        members: dict[str, Any] = {name: program[name] for name in program}
        uniforms = {n: m for n, m in members.items() if isinstance(m, moderngl.Uniform)}
        samplers = {n: m for n, m in uniforms.items() if m.gl_type in _SAMPLERS}  # type: ignore[attr-defined]
        others = {n: m for n, m in uniforms.items() if n not in samplers}
        # Programs of one pass read these images from equal units, where they stay bound.
        shared = [name for name in _SHARED if name in samplers]
        return cls(program, others, {n: samplers[n] for n in dict.fromkeys([*shared, *samplers])})

    @cached_property
    def screen(self) -> moderngl.VertexArray:
        """The vertex array that draws one triangle over the target."""
        return self.program.ctx.vertex_array(self.program, [])


@dataclass(eq=False)
class Uploaded:
    """A part on the GPU, which all its poses share.

    setup : vertices of the pose that the GPU holds
    columns : attributes that all poses share, see :func:`fixed_attributes`
    moving : positions and normals, which change with the pose
    content : buffers of interleaved vertex attributes, each with their widths by name
    arrays : cache of vertex arrays, by program and by name of the order, None for all triangles
    chosen : vertex indices of the triangles that :meth:`choose` chose, by the name of the order
    selected, texels : texture of the triangles that face the camera, if used; and its content
    table : framebuffer of the triangle table, with IN_ROW triangles in a row; None before its first
        use. ``shaders/host/triangle_table.frag`` draws it
    table_inputs : textures that this shader reads: "vertices", "attributes" and "faces"
    table_setup : vertices of the pose that the table holds; None if it is empty
    """

    gl: moderngl.Context
    setup: TriangleSetup
    columns: Mapping[str, NDArray[np.floating[Any]]]
    moving: moderngl.Buffer
    content: Sequence[tuple[moderngl.Buffer, Mapping[str, int]]]
    indices: moderngl.Buffer
    arrays: WeakKeyDictionary[CompiledProgram, dict[str | None, moderngl.VertexArray]] = field(
        default_factory=WeakKeyDictionary
    )
    chosen: dict[str, moderngl.Buffer] = field(default_factory=dict)
    selected: moderngl.Texture | None = None
    texels: Float32 = field(default_factory=lambda: np.empty(0, dtype=np.float32))
    table: moderngl.Framebuffer | None = None
    table_inputs: Mapping[str, moderngl.Texture] = field(default_factory=dict)
    table_setup: TriangleSetup | None = None

    @classmethod
    def of(cls, gl: moderngl.Context, part: Part, setup: TriangleSetup) -> Uploaded:
        """Upload a part."""
        moving = gl.buffer(setup.vertices, dynamic=True)
        content = [(moving, {"in_position": 3, "in_normal": 3})]
        if columns := fixed_attributes(part):
            rows = np.hstack([*columns.values()], dtype=np.float32, casting="same_kind")
            content.append((gl.buffer(rows), {name: c.shape[1] for name, c in columns.items()}))
        return cls(gl, setup, columns, moving, content, gl.buffer(setup.faces))

    def move(self, setup: TriangleSetup) -> None:
        """Upload another pose."""
        self.moving.write(setup.vertices)
        self.setup = setup

    def choose(self, name: Order, order: Integers) -> int:
        """Upload the indices of triangles (F,) for arrays of this order. Return their number."""
        if not (count := len(order)):
            return 0
        self.buffer(name).write(self.setup.faces.take(order, axis=0))
        if self.selected is not None and name == "facing":
            rows = -(-count // IN_ROW)
            self.texels[:count] = order  # no draw reads those behind
            self.selected.write(self.texels[: rows * IN_ROW], (0, 0, IN_ROW, rows))
        return count

    def make_table(self) -> None:
        """Make an empty triangle table. It has no second texture coordinates."""
        gl, count, faces = self.gl, len(self.setup.positions), self.setup.faces
        columns = (rows for name, rows in self.columns.items() if name != "in_uv2")
        values = np.hstack([np.empty((count, 0)), *columns])
        texels = max(-(-values.shape[1] // 3), 1)  # of three channels, for each vertex
        attributes = np.zeros((count, 3 * texels), dtype=np.float32)
        attributes[:, : values.shape[1]] = values
        self.table_inputs = {
            "vertices": _empty(gl, count, 2, 3),
            "attributes": _empty(gl, count, texels, 3),
            "faces": _empty(gl, len(faces), 1, 3, "i4"),
        }
        _fill(self.table_inputs["attributes"], attributes)
        _fill(self.table_inputs["faces"], np.asarray(faces, dtype=np.int32))
        self.table = gl.framebuffer([_empty(gl, len(faces), TABLE_TEXELS + values.shape[1], 4)])

    def buffer(self, name: Order) -> moderngl.Buffer:
        """Return the vertex indices of the chosen triangles of an order."""
        if name not in self.chosen:
            self.chosen[name] = self.gl.buffer(reserve=self.indices.size, dynamic=True)
        return self.chosen[name]

    def array(
        self, compiled: CompiledProgram, order: Integers | Order | None = None
    ) -> moderngl.VertexArray:
        """Return the vertex array that a program reads, from the cache, except for a fixed order.

        order : indices of the triangles; a name for the chosen ones; None for all
        """
        program, arrays = compiled.program, self.arrays.setdefault(compiled, {})
        if not isinstance(order, np.ndarray) and order in arrays:
            return arrays[order]
        content = []
        for buffer, widths in self.content:
            if used := [name for name in widths if name in program]:
                parts = (f"{n}f" if name in used else f"{n}x4" for name, n in widths.items())
                content.append((buffer, " ".join(parts), *used))
        if isinstance(order, np.ndarray):
            return self.gl.vertex_array(program, content, self.gl.buffer(self.setup.faces[order]))
        indices = self.buffer(order) if order else self.indices
        arrays[order] = self.gl.vertex_array(program, content, indices)
        return arrays[order]


def _empty(
    gl: moderngl.Context, count: int, texels: int, components: int, dtype: str = "f4"
) -> moderngl.Texture:
    """Return a texture for `count` items of several texels, IN_ROW items in a row."""
    texture = gl.texture((IN_ROW * texels, -(-count // IN_ROW)), components, dtype=dtype)
    texture.filter = moderngl.NEAREST, moderngl.NEAREST
    return texture


def _fill(texture: moderngl.Texture, values: Array) -> None:
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


@dataclass(eq=False)
class Canvas:
    """A target on the GPU.

    held : what its image shows, if a pass that may be skipped drew it: see ``Pass.key``
    """

    framebuffer: moderngl.Framebuffer
    held: Hashable = None


class Resources:
    """Cache of the GPU objects of one context.

    frames : compiled frames of each appearance, by size and structure. The appearance owns them, so
        that no renderer keeps a mesh alive
    last_frame : token of the compiled frame whose uniforms the programs hold
    """

    def __init__(self, context: Context, anisotropy: float = 1.0) -> None:
        self.context, self.anisotropy = context, anisotropy
        self.parts: WeakKeyDictionary[Part, Uploaded] = WeakKeyDictionary()
        self.panoramas: WeakKeyDictionary[Panorama, moderngl.Texture] = WeakKeyDictionary()
        self.textures: WeakKeyDictionary[Texture, dict[Kind, moderngl.Texture]] = (
            WeakKeyDictionary()
        )
        self.programs: dict[Program, CompiledProgram] = {}  # least recently used first
        self.targets: dict[Target, Canvas] = {}
        self.last_frame: object = None
        self.frames: WeakKeyDictionary[Appearance, dict[Hashable, Any]] = WeakKeyDictionary()
        self._settled = True

    @cached_property
    def _functions(self) -> dict[str, Any]:
        """OpenGL functions that moderngl does not wrap; false if the driver lacks one."""
        integer, pointer = ctypes.c_int, ctypes.c_void_p
        types: dict[str, list[Any]] = {
            "glFramebufferRenderbuffer": [integer] * 4,
            "glTexSubImage2D": [*[integer] * 8, pointer],
            "glTexParameteri": [integer] * 3,
            "glTexStorage2D": [integer] * 5,
            "glTexImage2D": [*[integer] * 8, pointer],
        }
        load = self.context.loader.load
        return {name: ctypes.CFUNCTYPE(None, *words)(load(name)) for name, words in types.items()}

    def release(self) -> None:
        """Free all GPU objects. The context must be current."""
        caches = self.parts, self.panoramas, self.textures, self.programs, self.targets
        for cache in (*caches, self.frames):
            cache.clear()
        self.last_frame = None
        self.context.gl.gc()

    def evict_unused(self) -> None:
        """Free dropped objects and return freed memory to the system, before each frame.

        malloc keeps the memory that decoders, uploads and compilers freed (110 MiB for the built-in
        head). After a frame that created GPU objects, this memory is released, and so are the
        pages of mip chains in mapped files. The context must be current.
        """
        self.context.gl.gc()
        if not self._settled:
            for texture, uploaded in self.textures.items():
                for mip_kind in uploaded if not texture.coarse else ():
                    unload(texture.levels(mip_kind).result())
            give_back()
        self._settled = True

    def upload_reduced(self, parts: Sequence[ResolvedPart]) -> None:
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

    def target(self, target: Target, area: Area | None = None) -> Canvas:
        """Return a target on the GPU, created on first use.

        area : pixels that a pass draws. A target that shares a depth buffer is only as large as its
            passes need, because the images of several samples are large
        """
        gl, size, canvas = self.context.gl, target.size, self.targets.get(target)
        assert size  # see ``compiled.sized``
        if target.depth_of is not None and area is not None:
            minimum = canvas.framebuffer.size if canvas else (_STEP, _STEP)
            right, top = (-(-(area[i] + area[i + 2]) // _STEP) * _STEP for i in (0, 1))
            size = min(size[0], max(right, minimum[0])), min(size[1], max(top, minimum[1]))
            if canvas and size != minimum:
                del self.targets[target]
                canvas = None
                gl.gc()
        if canvas:
            return canvas
        self._settled = False
        samples = target.samples if target.samples > 1 else 0
        try:
            resolved = samples and target.resolved
            make = gl.texture if target.sampled and not resolved else gl.renderbuffer
            colors: list[Any] = [
                make(size, count, samples=samples, dtype="f4") for count in target.channels
            ]
            if target.sampled and not samples:
                for color in colors:
                    color.filter = moderngl.NEAREST, moderngl.NEAREST
            if target.depth_of is None:
                framebuffer = gl.framebuffer(colors, gl.depth_renderbuffer(size, samples=samples))
            else:  # moderngl refuses the depth buffer of a larger framebuffer
                depth: Any = self.target(target.depth_of).framebuffer.depth_attachment
                framebuffer = gl.framebuffer(colors)
                framebuffer.use()
                attach = self._functions["glFramebufferRenderbuffer"]
                attach(_FRAMEBUFFER, _DEPTH_ATTACHMENT, _RENDERBUFFER, depth.glo)
        except moderngl.Error as error:
            raise ContextError(
                f"{self.context.renderer} cannot draw {size[0]} x {size[1]} pixels with "
                f"{target.samples} samples ({error}); lower the size or the samples"
            ) from None
        self.targets[target] = Canvas(framebuffer)
        return self.targets[target]

    def program(self, source: Program) -> CompiledProgram:
        """Return the compiled program from the cache, or compile it. Beyond MAX_PROGRAMS, the
        least recently used one leaves the cache; compiled frames that draw with it keep it."""
        if source in self.programs:
            self.programs[source] = self.programs.pop(source)
            return self.programs[source]
        self._settled = False
        gl, stages = self.context.gl, source.sources("330 core")
        try:
            program = gl.program(vertex_shader=stages["vert"], fragment_shader=stages["frag"])
        except moderngl.Error as error:
            problem = f"{self.context.renderer} cannot compile a program"
            raise ContextError(f"{problem}: {error}") from None
        self.programs[source] = compiled = CompiledProgram.of(program)
        if len(self.programs) > MAX_PROGRAMS:
            del self.programs[next(iter(self.programs))]
        return compiled

    def part(
        self, part: ResolvedPart, draw: Draw, setup: TriangleSetup, program: CompiledProgram
    ) -> tuple[Uploaded, moderngl.VertexArray, dict[str, moderngl.Texture]]:
        """Return the part of a draw on the GPU, which is uploaded on first use in the given pose;
        the vertex array of the draw; and the textures of the part that its program reads."""
        if part.part not in self.parts:
            self.parts[part.part] = Uploaded.of(self.context.gl, part.part, setup)
        uploaded, samplers = self.parts[part.part], program.samplers
        textures = {map_[0]: self.texture(*map_) for map_ in part.maps if map_[0] in samplers}
        if draw.depth in OF_TABLE:
            if uploaded.table is None:
                self._settled = False
                uploaded.make_table()
            (textures["triangle_table"],) = uploaded.table.color_attachments  # type: ignore
        if "selected_triangles" in samplers:
            if uploaded.selected is None:
                count = len(setup.faces)
                uploaded.texels = np.empty(-(-count // IN_ROW) * IN_ROW, dtype=np.float32)
                uploaded.selected = _empty(self.context.gl, count, 1, 1)
            textures["selected_triangles"] = uploaded.selected
        screen = draw.depth in ("mark", *OF_TABLE)
        array = program.screen if screen else uploaded.array(program, draw.order)
        return uploaded, array, textures

    def draw_table(self, part: ResolvedPart) -> None:
        """Draw the triangle table of a part for the pose that the GPU holds."""
        uploaded = self.parts[part.part]
        table, inputs = uploaded.table, uploaded.table_inputs
        assert table  # a compiled frame reads it
        _fill(inputs["vertices"], uploaded.setup.vertices)
        texels = table.width // IN_ROW, inputs["attributes"].width // IN_ROW
        macros = (
            *(f"TRIANGLES_IN_ROW {IN_ROW}", f"TRIANGLE_TEXELS {texels[0]}"),
            *(f"VERTICES_IN_ROW {IN_ROW}", f"ATTRIBUTE_TEXELS {texels[1]}"),
        )
        program = self.program(Program("triangle_table.frag", "screen.vert", macros))
        for unit, (name, sampler) in enumerate(program.samplers.items()):
            inputs[name].use(unit)
            sampler.value = unit
        table.use()
        self.context.gl.enable_only(moderngl.NOTHING)
        program.screen.render(vertices=3)
        uploaded.table_setup = uploaded.setup

    def panorama(self, source: Panorama) -> moderngl.Texture:
        """Return the texture of a panorama, which is uploaded on first use."""
        if source not in self.panoramas:
            self._settled = False
            height, width, components = source.map.shape
            texture = self.context.gl.texture((width, height), components, source.map, dtype="f4")
            texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self.panoramas[source] = texture
        return self.panoramas[source]

    def texture(self, name: str, source: Texture, mip_kind: Kind) -> moderngl.Texture:
        """Return the texture of a map, whose mip chain is uploaded on first use.

        All mip levels come from texture.py: moderngl's build_mipmaps takes 65 ms for 2048 x 2048
        texels on a software driver.
        """
        uploaded = self.textures.setdefault(source, {})
        if mip_kind in uploaded:
            return uploaded[mip_kind]
        self._settled = False
        levels = source.levels(mip_kind).result()
        if source.coarse:
            give_back()  # the images that the mip chain was made of
        gl = self.context.gl
        internal, components, layout, data_type, dtype = _FORMATS[mip_kind]
        height, width = levels[0].shape[:2]
        limit = gl.info["GL_MAX_TEXTURE_SIZE"]
        if max(width, height) > limit:
            remedy = f"this driver allows at most {limit} a side; give a smaller map"
            raise InputError(f"{source.name} is {width} x {height} texels: {remedy}")
        first_texel = levels[0][:1, :1].copy()  # sets the unpack alignment to 1 for all levels
        texture = gl.texture((1, 1), components, first_texel, 0, 1, dtype, internal_format=internal)
        texture.use(0)
        self._reserve(internal, [level.shape for level in levels], layout, data_type)
        upload = self._functions["glTexSubImage2D"]
        for index, level in enumerate(levels):
            texels = np.ascontiguousarray(level)
            rectangle = 0, 0, level.shape[1], level.shape[0]
            upload(_TEXTURE_2D, index, *rectangle, layout, data_type, texels.ctypes.data)
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
        for axis, wrap in zip(_WRAP_AXES, source.wrap, strict=True):
            self._functions["glTexParameteri"](_TEXTURE_2D, axis, _WRAPS[wrap])
        uploaded[mip_kind] = texture
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
        if store := self._functions["glTexStorage2D"]:  # OpenGL 4.2, or ARB_texture_storage
            store(_TEXTURE_2D, count, internal, width, height)
            return
        image = self._functions["glTexImage2D"]
        for index, (height, width, *_) in enumerate(shapes):
            image(_TEXTURE_2D, index, internal, width, height, 0, layout, data_type, None)


def free_dropped(resources: Resources) -> None:
    """Free the GPU objects of a renderer that was garbage-collected without release.

    In a context of the host that is not current, they remain until the host frees the context.
    """
    if resources.context.closed:
        return
    message = "a Renderer was dropped without release(): create it in a with statement"
    warnings.warn(message, ResourceWarning, stacklevel=2)
    with suppress(ContextError):
        resources.context.release(resources.release)
