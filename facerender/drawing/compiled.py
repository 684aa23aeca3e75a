"""Compiled frames: passes whose programs, vertex arrays, textures and targets are looked up once. A
compiled frame draws its passes for any camera, and for any pose of its mesh. For each drawing it

1. computes what depends on the view: bounds, triangles that face the camera, blended triangles in
   order, and the uniforms of the camera
2. uploads all of this, and a changed pose, before the first draw: a later upload waits for draws
3. replays the draws, and skips passes whose target still holds their image

Uniforms belong to a program, which several draws may share. A uniform that is equal in all draws of
a frame is written when another frame was drawn before; other uniforms are written before each draw.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np

from facerender.drawing.program import ENVIRONMENT_MAP, Draw, Order, Pass, Target, Uniforms
from facerender.drawing.resources import OF_TABLE, Canvas, CompiledProgram, Resources, Uploaded
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Area, TriangleSetup, areas_of
from facerender.scene.view import View
from facerender.values.vectors import Float, Float32, Size

if TYPE_CHECKING:
    from facerender.scene.environment import Panorama

_ALL, _NOTHING = (True,) * 4, (False,) * 4
# SAMPLE_ALPHA_TO_COVERAGE and SAMPLE_ALPHA_TO_ONE, for draws with the feature TO_COVERAGE.
_TO_COVERAGE = (0x809E, 0x809F)
# By Draw.depth: whether colours and depth are written, and the depth test.
_STATES = {
    "test": (_ALL, True, "<="),
    "hide": (_NOTHING, True, "<="),
    "blend": (_ALL, False, "<="),
    "mark": (_NOTHING, True, "1"),
    "marked": (_ALL, False, "=="),
    "visible": (_ALL, False, "1"),
}
_UNKNOWN = (None,) * 5
_FAR_CORNERS = np.array([[-1, -1, 1, 1], [1, -1, 1, 1], [-1, 1, 1, 1]], dtype=float)

_Counts = dict[tuple[int, Order], int]
Values = list[tuple[Any, bytes]]  # uniforms, of which moderngl's type lacks some attributes


@dataclass(eq=False, slots=True)
class _Call:
    """A draw with its OpenGL objects.

    part : index of the part; -1 for none
    order : name of the order, if the triangles depend on the view
    area : rectangle to draw, or the key of the view's bounds
    state : write masks, depth test, enabled capabilities and blend function
    count : number of vertices; -1 for all
    covers : whether alpha becomes coverage
    textures : textures with their units
    uniforms : values that the draws of the program do not share
    """

    array: moderngl.VertexArray
    part: int
    order: Order | None
    area: Any
    state: tuple[Any, ...]
    count: int
    covers: bool
    textures: list[tuple[moderngl.Texture, int]]
    uniforms: Values = field(default_factory=list)


@dataclass(eq=False, slots=True)
class _Step:
    """A pass with its OpenGL objects.

    single : framebuffer with one value per pixel; None if the target has no samples to resolve
    blends : slice of the calls that are sorted by depth
    """

    source: Pass
    canvas: Canvas
    single: moderngl.Framebuffer | None
    calls: list[_Call]
    blends: slice


class CompiledFrame:
    """The passes of a frame as OpenGL objects; see the head of this module.

    size : width and height in pixels
    panorama : panorama of the environment that lights the scene; None for none
    inputs : further textures of the passes by uniform name: none of them is an image of a pass
    """

    def __init__(
        self,
        resources: Resources,
        passes: Sequence[Pass],
        size: Size,
        panorama: Panorama | None = None,
        inputs: Mapping[str, moderngl.Texture] = {},
    ) -> None:
        self.resources, self.passes, self.size = resources, passes, size
        self.panorama, self.inputs = panorama, inputs
        self._token = object()
        self._state: tuple[Any, ...] = _UNKNOWN  # of the draw before
        self._steps: list[_Step] = []
        self._constant: Values = []
        self._camera: dict[str, list[Any]] = {}
        draws = [(draw.part, draw) for one in passes for draw in one.draws if draw.part]
        # Parts by index; indices of parts whose triangle table is read, and by their order.
        self._parts = {part.index: part for part, _ in draws}
        self._tables = {part.index for part, draw in draws if draw.depth in OF_TABLE}
        orders = {(p.index, draw.order) for p, draw in draws if isinstance(draw.order, str)}
        self._facing = sorted(index for index, order in orders if order == "facing")
        self._sorted = sorted(index for index, order in orders if order == "sorted")
        marked = sorted({part.index for part, draw in draws if draw.depth == "marked"})
        used = {area for one in passes for area in (one.area, *(draw.area for draw in one.draws))}
        groups = {"blended": self._sorted, "opaque": marked}
        self._groups = {name: group for name, group in groups.items() if name in used}
        self._uploaded: dict[int, Uploaded] = {}
        self._bounds: tuple[Any, Float] = (None, np.empty(0))

    # --- compiling -------------------------------------------------------------------------------

    def _compile(self, setups: list[TriangleSetup], blended: Area) -> None:
        """Look up all OpenGL objects. For errors see :meth:`draw`.

        blended : bounds of the blended parts
        """
        resources, steps = self.resources, []
        textures = dict(self.inputs)
        if self.panorama is not None:
            textures[ENVIRONMENT_MAP] = resources.panorama(self.panorama)
        users: dict[CompiledProgram, list[tuple[_Call, Uniforms]]] = {}
        for render_pass in self.passes:
            target = sized(render_pass.target, self.size)
            canvas, single = resources.target(target, blended), None
            framebuffer = canvas.framebuffer
            calls = []
            for draw in render_pass.draws:
                program, uniforms = resources.program(draw.program), render_pass.uniforms
                calls.append(call := self._call(draw, render_pass, program, setups, textures))
                users.setdefault(program, []).append((call, {**uniforms, **draw.uniforms}))
            _bind_once(calls)
            if target.samples > 1 and target.resolved:
                single = resources.target(replace(target, samples=1)).framebuffer
            if target.sampled:
                images: Any = (single or framebuffer).color_attachments
                textures |= zip((render_pass.name, *render_pass.others), images, strict=False)
            sorts = [index for index, call in enumerate(calls) if call.order == "sorted"]
            blends = slice(sorts[0], sorts[-1] + 1) if sorts else slice(0, 0)
            steps.append(_Step(render_pass, canvas, single, calls, blends))
        self._constant, self._camera = [], {}
        for program, pairs in users.items():
            self._share(program, pairs)
        self._steps, resources.last_frame = steps, None

    def _call(
        self,
        draw: Draw,
        render_pass: Pass,
        program: CompiledProgram,
        setups: list[TriangleSetup],
        textures: Mapping[str, moderngl.Texture],
    ) -> _Call:
        part, array, bound = draw.part, program.screen, dict(textures)
        if part is not None:
            setup = setups[part.index]
            uploaded, array, inputs = self.resources.part(part, draw, setup, program)
            self._uploaded[part.index] = uploaded
            bound |= inputs
        blended = draw.depth == "blend"
        flags = moderngl.DEPTH_TEST | moderngl.BLEND * (render_pass.added or blended)
        flags |= moderngl.CULL_FACE * (draw.double_sided is False)
        factor = moderngl.ONE_MINUS_SRC_ALPHA if blended else moderngl.ONE
        order = draw.order if isinstance(draw.order, str) else None
        area: Any = draw.area or (0, 0, *(render_pass.target.size or self.size))
        area = part.index if part and area == "part" else area
        state, count = (*_STATES[draw.depth], flags, factor), 3 if array is program.screen else -1
        covers = "TO_COVERAGE" in " ".join(draw.program.features)
        units = [(bound[name], i) for i, name in enumerate(program.samplers) if name in bound]
        return _Call(array, part.index if part else -1, order, area, state, count, covers, units)

    def _share(self, program: CompiledProgram, users: Sequence[tuple[_Call, Uniforms]]) -> None:
        """Sort the uniforms of a program: of the camera, equal in all draws, and different ones."""
        for unit, sampler in enumerate(program.samplers.values()):
            self._constant.append((sampler, struct.pack("i", unit)))
        for name, uniform in program.uniforms.items():
            pairs = [(call, values[name]) for call, values in users if name in values]
            if not pairs:
                if name in _CAMERA:
                    self._camera.setdefault(name, []).append(uniform)
                continue
            first = pairs[0][1]
            shared = all(value is first for _, value in pairs)
            packed = [_packed(uniform, value) for _, value in (pairs[:1] if shared else pairs)]
            if packed.count(packed[0]) == len(packed):
                self._constant.append((uniform, packed[0]))
                continue
            for (call, _), data in zip(pairs, packed, strict=True):
                call.uniforms.append((uniform, data))

    # --- drawing ---------------------------------------------------------------------------------

    def draw(self, view: View, mesh: Mesh) -> list[Float32]:
        """Draw all passes for a camera and a pose, and return their results, (H, W, channels) each;
        see ``Pass.results``. The context must be current.

        Raises InputError if a map is damaged or too large, and ContextError if the driver refuses a
        target or a program.
        """
        resources, setups = self.resources, mesh.setups
        # Bounds in the image: of each part by its index, and by the names of Bounds.
        areas: dict[Any, Area] = {}
        if self._parts:
            if self._bounds[0] is not setups:
                self._bounds = setups, np.array([setup.bounds for setup in setups], dtype=float)
            areas = areas_of(self._bounds[1], view.matrix, self.size, self._groups)
        blended = areas.get("blended") or Area()
        right, low = blended[0] + blended[2], blended[1] + blended[3]
        for step in self._steps:
            columns, rows = step.canvas.framebuffer.size
            if step.source.area is not None and (right > columns or low > rows):
                self._steps = []  # the target is too small for the blended parts
                break
        if not self._steps:
            self._compile(setups, blended)
        counts, nearest = self._upload(view, setups)
        for index in self._facing:
            if not counts[index, "facing"]:
                areas[index] = Area()
        if resources.last_frame is not self._token:
            for uniform, data in self._constant:
                uniform.write(data)
            resources.last_frame = self._token
        for name, uniforms in self._camera.items():
            values = _CAMERA[name](view, self.size)
            for uniform in uniforms:
                uniform.write(values)
        resources.context.gl.cull_face = "front"  # the image is drawn upside down
        self._state, token = _UNKNOWN, mesh.token
        for step in self._steps:
            bounds, key, canvas = step.source.area, step.source.key, step.canvas
            if bounds is not None and not areas[bounds].width:  # nothing is blended in the image
                continue
            if key is not None and canvas.held == (key, token):
                continue
            canvas.held = None  # an error leaves an incomplete image
            self._replay(step, areas, counts, nearest)
            canvas.held = None if key is None else (key, token)
        return [
            read(step.single or step.canvas.framebuffer, index, step.source.target.channels[index])
            for step in self._steps
            for index in step.source.results
        ]

    def _upload(self, view: View, setups: list[TriangleSetup]) -> tuple[_Counts, dict[int, float]]:
        """Upload a changed pose and the triangles that depend on the view. Return the number of
        chosen triangles, by part and order, and the nearest depth of blended parts."""
        counts: _Counts = {}
        nearest = {}
        for index, uploaded in self._uploaded.items():
            if uploaded.setup is not setups[index]:
                uploaded.move(setups[index])
            if index in self._tables and uploaded.table_setup is not setups[index]:
                self.resources.draw_table(self._parts[index])
        for index in self._facing:
            order = setups[index].facing(view.eye)
            counts[index, "facing"] = self._uploaded[index].choose("facing", order)
        for index in self._sorted:
            setup = setups[index]
            depth = setup.positions @ view.forward
            order = (-np.add.reduce(depth[setup.faces], 1)).argsort(kind="stable")
            nearest[index] = float(np.minimum.reduce(depth))
            counts[index, "sorted"] = self._uploaded[index].choose("sorted", order)
        return counts, nearest

    def _replay(
        self, step: _Step, areas: Mapping[Any, Area], counts: _Counts, nearest: Mapping[int, float]
    ) -> None:
        gl, framebuffer = self.resources.context.gl, step.canvas.framebuffer
        target, calls, clear = step.source.target, step.calls, step.source.clear
        if step.blends.stop - step.blends.start > 1:
            blends = sorted(calls[step.blends], key=lambda call: -nearest[call.part])
            calls = [*calls[: step.blends.start], *blends, *calls[step.blends.stop :]]
        viewport: Any = (0, 0, *(target.size or self.size))
        framebuffer.color_mask = _masks(_ALL, target)
        framebuffer.depth_mask = target.depth_of is None
        framebuffer.viewport = viewport
        framebuffer.use()  # applies the colour masks
        if clear is not None:
            framebuffer.clear(*clear, viewport=areas.get(step.source.area))
        if target.depth_of:
            framebuffer.depth_mask = True
        state = (_ALL, True, *self._state[2:])
        for call in calls:
            for texture, unit in call.textures:
                texture.use(unit)
            area = areas.get(call.area, call.area)
            if not (area[2] and area[3]):
                continue
            if call.state != state:
                colors, depth, test, flags, factor = call.state
                if colors is not state[0]:
                    framebuffer.color_mask = _masks(colors, target)
                    framebuffer.use()
                if depth is not state[1]:
                    framebuffer.depth_mask = depth
                if test != state[2]:
                    gl.depth_func = test
                if flags != state[3]:
                    gl.enable_only(flags)
                if (flags, factor) != state[3:]:
                    gl.blend_func = moderngl.ONE, factor
                state = call.state
            if area != viewport:
                framebuffer.viewport = viewport = area
            for uniform, data in call.uniforms:
                uniform.write(data)
            vertices = 3 * counts[call.part, call.order] if call.order else call.count
            capabilities = _TO_COVERAGE if call.covers else ()
            for capability in capabilities:
                gl.enable_direct(capability)
            try:
                call.array.render(vertices=vertices)
            finally:
                for capability in capabilities:
                    gl.disable_direct(capability)
        self._state = state
        if step.single:
            gl.copy_framebuffer(step.single, framebuffer)


def _masks(mask: tuple[bool, ...], target: Target) -> Any:
    """Return moderngl's colour masks of a target: one mask, or a list."""
    return mask if len(target.channels) == 1 else [mask] * len(target.channels)


def _bind_once(calls: Sequence[_Call]) -> None:
    """Remove the textures that the draw before has bound to the same unit."""
    bound: dict[int, moderngl.Texture] = {}
    for call in calls:
        if call.order:  # the view decides the order of blended parts
            bound.clear()
            continue
        before = dict(bound)
        bound |= {unit: texture for texture, unit in call.textures}
        call.textures = [(t, unit) for t, unit in call.textures if before.get(unit) is not t]


def read(target: moderngl.Framebuffer, index: int, channels: int) -> Float32:
    """Return an image (H, W, channels) of a framebuffer that has no multisampling."""
    pixels = np.empty((target.height, target.width, channels), dtype=np.float32)
    target.read_into(pixels, components=channels, attachment=index, dtype="f4")
    return pixels


def sized(target: Target, size: Size) -> Target:
    """Return a target with an explicit size, which is the frame's unless it has one."""
    below = target.depth_of and sized(target.depth_of, size)
    return replace(target, size=target.size or size, depth_of=below)


def _packed(uniform: Any, value: Any) -> bytes:
    """Return the bytes of a value. Compilers shorten arrays whose last elements are unread."""
    if isinstance(value, np.ndarray):
        size = uniform.array_length * uniform.element_size
        return value.astype(np.float32).tobytes()[:size]
    values = value if isinstance(value, tuple) else (value,)
    return struct.pack(uniform.fmt, *values)


def _rays(view: View, size: Size) -> Float32:
    """Return the columns of a matrix: the ray from the camera to the outer corner of pixel (0, 0),
    and the change of the ray per pixel in x and y. The parallel rays of an orthographic camera
    differ in their starts, which replace the rays."""
    far = _FAR_CORNERS @ np.linalg.inv(view.matrix)
    rays = far[:, :3] / far[:, 3:] - (_span(view) if view.orthographic else view.position)
    rays[1] = (rays[1] - rays[0]) / size[0]
    rays[2] = (rays[2] - rays[0]) / size[1]
    return np.asarray(rays, dtype=np.float32)


def _span(view: View) -> Float:
    """Return the vector of an orthographic camera's rays, from their starts to the far plane. They
    start before the near plane, because visible.glsl leaves out their first 0.1 %."""
    return 2.02 / np.linalg.norm(view.matrix[:3, 2]) * view.forward


# The uniforms of the camera, by name.
_CAMERA: dict[str, Callable[[View, Size], Float32]] = {
    "view_projection": lambda view, size: view.matrix.astype(np.float32),
    "camera_position": lambda view, size: np.array(
        [*-_span(view), 0.0] if view.orthographic else view.eye, np.float32
    ),
    "forward": lambda view, size: view.forward.astype(np.float32),
    "rays": _rays,
    "shadow_phase": lambda view, size: view.phase.astype(np.float32),
}
