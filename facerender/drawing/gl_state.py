"""The current OpenGL context of a host program, and functions that save and restore the context's
state. No drawing here."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class HostContext:
    """The OpenGL context that is current in this thread.

    handle : address of the context, which identifies it
    get_proc_address : C function that returns the address of an OpenGL function
    rebind : function that makes the context current again, even if the window system regards it as
        current
    """

    handle: int
    get_proc_address: Any
    rebind: Callable[[], None]


def current_context() -> HostContext | None:
    """Return the EGL, GLX or OSMesa context that is current in this thread, or None.

    A context that was current before a fork is ignored: its driver's threads do not exist in the
    child process.
    """
    for find in (_egl, _glx, _osmesa):
        if (context := find()) is not None and context.handle not in _inherited:
            return context
    return None


_inherited: set[int] = set()  # handles of contexts that were current before a fork


def _disown() -> None:
    while (host := current_context()) is not None:
        _inherited.add(host.handle)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_disown)


_libraries: dict[str, ctypes.CDLL] = {}


def _loaded(*names: str) -> ctypes.CDLL | None:
    """Return the first library in `names` that the process has already loaded, or None.

    A library that is not loaded has no current context. On Windows the result is None.
    """
    for name in names if sys.platform != "win32" else ():
        if name not in _libraries:
            try:
                _libraries[name] = ctypes.CDLL(name, mode=os.RTLD_NOLOAD | os.RTLD_NOW)
            except OSError:
                continue
        return _libraries[name]
    return None


def _pointer(function: Any, *arguments: Any) -> int | None:
    function.restype = ctypes.c_void_p
    address: int | None = function(*arguments)
    return address


def _egl() -> HostContext | None:
    library = _loaded("libEGL.so.1")
    if library is None or not (context := _pointer(library.eglGetCurrentContext)):
        return None
    display = _pointer(library.eglGetCurrentDisplay)
    draw, read = (_pointer(library.eglGetCurrentSurface, name) for name in (0x3059, 0x305A))
    make_current = library.eglMakeCurrent
    make_current.argtypes = [ctypes.c_void_p] * 4

    def rebind() -> None:
        make_current(display, None, None, None)
        make_current(display, draw, read, context)

    return HostContext(context, library.eglGetProcAddress, rebind)


def egl_in_use() -> bool:
    """Return whether any code in this process has initialised an EGL device display."""
    library = _loaded("libEGL.so.1")
    if library is None:
        return False
    library.eglGetProcAddress.restype = ctypes.c_void_p
    names = b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT"
    functions = [library.eglGetProcAddress(name) for name in names]
    if not all(functions):
        return False
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    get = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)
    devices, count = (ctypes.c_void_p * 16)(), ctypes.c_int()
    query(functions[0])(len(devices), devices, ctypes.byref(count))
    library.eglQueryString.argtypes = [ctypes.c_void_p, ctypes.c_int]
    # 0x3054 is EGL_VERSION: only an initialised display has a version.
    return any(
        _pointer(library.eglQueryString, get(functions[1])(0x313F, device, None), 0x3054)
        for device in devices[: count.value]
    )


def _glx() -> HostContext | None:
    library = _loaded("libGLX.so.0", "libGL.so.1")
    if library is None or not (context := _pointer(library.glXGetCurrentContext)):
        return None
    display = _pointer(library.glXGetCurrentDisplay)
    draw = _pointer(library.glXGetCurrentDrawable)
    read = _pointer(library.glXGetCurrentReadDrawable)
    make_current = library.glXMakeContextCurrent
    make_current.argtypes = [ctypes.c_void_p, ctypes.c_ulong, ctypes.c_ulong, ctypes.c_void_p]

    def rebind() -> None:
        make_current(display, 0, 0, None)
        make_current(display, draw or 0, read or 0, context)

    return HostContext(context, library.glXGetProcAddressARB, rebind)


def bind_osmesa(
    library: ctypes.CDLL, context: int | None, buffer: Any, width: int, height: int
) -> bool:
    """Make an OSMesa context current with a buffer of RGBA bytes. If `context` is None, unbind the
    current context. Return whether OSMesa succeeded."""
    make_current = library.OSMesaMakeCurrent
    make_current.argtypes = [ctypes.c_void_p, ctypes.c_void_p] + [ctypes.c_int] * 3
    unsigned_byte = 0x1401
    return bool(make_current(context, buffer, unsigned_byte, width, height))


def _osmesa() -> HostContext | None:
    library = _loaded("libOSMesa.so.8", "libOSMesa.so.6")
    if library is None or not (context := _pointer(library.OSMesaGetCurrentContext)):
        return None
    width, height, layout = (ctypes.c_int() for _ in range(3))
    buffer = ctypes.c_void_p()
    outputs = [ctypes.byref(output) for output in (width, height, layout, buffer)]
    library.OSMesaGetColorBuffer(ctypes.c_void_p(context), *outputs)

    def rebind() -> None:
        bind_osmesa(library, context, buffer, width.value, height.value)

    return HostContext(context, library.OSMesaGetProcAddress, rebind)


# OpenGL capabilities, keyed by name: (OpenGL constant, whether drawing needs it enabled).
CAPABILITIES = {
    "BLEND": (0x0BE2, False),
    "CULL_FACE": (0x0B44, False),
    "DEPTH_TEST": (0x0B71, False),
    "SCISSOR_TEST": (0x0C11, False),
    "STENCIL_TEST": (0x0B90, False),
    "POLYGON_OFFSET_FILL": (0x8037, False),
    "FRAMEBUFFER_SRGB": (0x8DB9, False),
    "RASTERIZER_DISCARD": (0x8C89, False),
    "PRIMITIVE_RESTART": (0x8F9D, False),
    "COLOR_LOGIC_OP": (0x0BF2, False),
    "MULTISAMPLE": (0x809D, True),
    "SAMPLE_ALPHA_TO_COVERAGE": (0x809E, False),
    "SAMPLE_ALPHA_TO_ONE": (0x809F, False),
    "SAMPLE_COVERAGE": (0x80A0, False),
    "SAMPLE_MASK": (0x8E51, False),
    "SAMPLE_SHADING": (0x8C36, False),
}

# Integer state: (setter, its leading arguments, queries for its other arguments, values that
# drawing needs for the other arguments). A query is (OpenGL constant, number of values). None: the
# drawing code sets the values. Setters that the driver lacks are skipped.
STATE: tuple[tuple[str, tuple[int, ...], tuple[tuple[int, int], ...], tuple[int, ...] | None], ...]
STATE = (
    ("glBindFramebuffer", (0x8CA9,), ((0x8CA6, 1),), None),  # draw
    ("glBindFramebuffer", (0x8CA8,), ((0x8CAA, 1),), None),  # read
    ("glBindRenderbuffer", (0x8D41,), ((0x8CA7, 1),), None),
    ("glBindVertexArray", (), ((0x85B5, 1),), None),
    ("glBindBuffer", (0x8892,), ((0x8894, 1),), None),  # array buffer
    ("glBindBuffer", (0x88EB,), ((0x88ED, 1),), (0,)),  # pixel pack buffer
    ("glBindBuffer", (0x88EC,), ((0x88EF, 1),), (0,)),  # pixel unpack buffer
    ("glUseProgram", (), ((0x8B8D, 1),), None),
    ("glViewport", (), ((0x0BA2, 4),), None),
    ("glScissor", (), ((0x0C10, 4),), None),
    ("glDepthFunc", (), ((0x0B74, 1),), (0x0203,)),  # less or equal
    ("glDepthMask", (), ((0x0B72, 1),), (1,)),
    ("glColorMask", (), ((0x0C23, 4),), (1, 1, 1, 1)),
    ("glFrontFace", (), ((0x0B46, 1),), (0x0901,)),  # counter-clockwise
    ("glCullFace", (), ((0x0B45, 1),), None),
    ("glPolygonMode", (0x0408,), ((0x0B40, 1),), (0x1B02,)),  # front and back, fill
    ("glBlendFuncSeparate", (), ((0x80C9, 1), (0x80C8, 1), (0x80CB, 1), (0x80CA, 1)), None),
    ("glBlendEquationSeparate", (), ((0x8009, 1), (0x883D, 1)), (0x8006, 0x8006)),  # add
    ("glClipControl", (), ((0x935C, 1), (0x935D, 1)), (0x8CA1, 0x935E)),  # lower left, -1 to 1
    *(("glPixelStorei", (name,), ((name, 1),), (0,)) for name in range(0x0D00, 0x0D05)),  # pack
    *(("glPixelStorei", (name,), ((name, 1),), (0,)) for name in range(0x0CF0, 0x0CF5)),  # unpack
    ("glPixelStorei", (0x0D05,), ((0x0D05, 1),), None),  # pack alignment
    ("glPixelStorei", (0x0CF5,), ((0x0CF5, 1),), None),  # unpack alignment
)
# Floating-point state: (setter, argument type, query, number of values, values that drawing needs).
_FLOATS: tuple[tuple[str, Any, int, int, tuple[float, ...] | None], ...] = (
    ("glClearColor", ctypes.c_float, 0x0C22, 4, None),
    ("glDepthRange", ctypes.c_double, 0x0B70, 2, (0.0, 1.0)),
)
_SWITCH = ("glDisable", "glEnable")
_TEXTURE_0, _ACTIVE_TEXTURE, _MOST_UNITS = 0x84C0, 0x84E0, 0x8B4D
# (texture target, query of the bound texture) for 2D textures and 2D multisample textures.
_TEXTURES = ((0x0DE1, 0x8069), (0x9100, 0x9104))
_SAMPLER_BINDING = 0x8919
# Texture units that every driver has for a fragment shader. Drawing uses up to 14: maps, triangle
# table, passes, shadow maps, environment.
_UNITS = 16


def save_state(load: Callable[[str], int]) -> Callable[[], None]:
    """Save the state of the current context, and set it to the values that drawing needs. Return
    the function that restores the previous state.

    load : function that returns the address of an OpenGL function, 0 if the driver lacks it
    """

    def function(name: str, *arguments: Any, result: Any = None) -> Any:
        return ctypes.CFUNCTYPE(result, *arguments)(load(name))

    def state_of(name: int, count: int = 1, kind: Any = ctypes.c_int) -> tuple[Any, ...]:
        values = (kind * count)()
        getter = "glGetIntegerv" if kind is ctypes.c_int else "glGetDoublev"
        function(getter, ctypes.c_int, ctypes.c_void_p)(name, values)
        return tuple(values)

    def call(name: str, *values: int | float, kind: Any = ctypes.c_int) -> None:
        function(name, *[kind] * len(values))(*values)

    is_enabled = function("glIsEnabled", ctypes.c_int, result=ctypes.c_ubyte)
    back: list[tuple[Any, str, tuple[float, ...]]] = []

    def change(
        name: str,
        old_values: tuple[float, ...],
        new_values: tuple[float, ...] | None,
        kind: Any = ctypes.c_int,
    ) -> None:
        back.append((kind, name, old_values))
        if new_values is not None:
            call(name, *new_values, kind=kind)

    for name, (capability, needed) in CAPABILITIES.items():
        if name == "SAMPLE_SHADING" and not load("glMinSampleShading"):
            continue
        back.append((ctypes.c_int, _SWITCH[bool(is_enabled(capability))], (capability,)))
        call(_SWITCH[needed], capability)
    for name, leading, queries, needed_integers in STATE:
        if load(name):
            state = tuple(value for query in queries for value in state_of(*query))
            new_values = None if needed_integers is None else leading + needed_integers
            change(name, leading + state, new_values)
    for name, kind, query, count, needed_floats in _FLOATS:
        change(name, state_of(query, count, ctypes.c_double), needed_floats, kind)
    active = state_of(_ACTIVE_TEXTURE)
    # moderngl binds each new texture to the last unit.
    for unit in (*range(_UNITS), state_of(_MOST_UNITS)[0] - 1):
        change("glActiveTexture", (_TEXTURE_0 + unit,), (_TEXTURE_0 + unit,))
        for target, binding in _TEXTURES:
            change("glBindTexture", (target, *state_of(binding)), None)
        change("glBindSampler", (unit, *state_of(_SAMPLER_BINDING)), (unit, 0))
    change("glActiveTexture", active, None)

    def restore() -> None:
        for kind, name, values in back:
            call(name, *values, kind=kind)

    return restore
