"""OpenGL 3.3 contexts without a window: EGL, OSMesa, the window system's (WGL, CGL, GLX), or the
current context of a host program, whose state is saved and restored. This module also detects
drivers that a fork has made unusable. No drawing here."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import glcontext
import moderngl

from facerender.errors import ContextError, check_known
from facerender.system import IMPORTER


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
    """Return the EGL, GLX or OSMesa context that is current in this thread, or None. One that was
    current before a fork is ignored: its driver's threads do not exist in the child process."""
    for find in (_egl_context, _glx_context, _osmesa_context):
        if (context := find()) is not None and context.handle not in _inherited:
            return context
    return None


_inherited: set[int] = set()  # handles of contexts that were current before a fork
_libraries: dict[str, ctypes.CDLL] = {}


def _loaded(*names: str) -> ctypes.CDLL | None:
    """Return the first library in `names` that the process has already loaded, None on Windows. A
    library that is not loaded has no current context."""
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


def _egl_context() -> HostContext | None:
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


def _glx_context() -> HostContext | None:
    library = _loaded("libGLX.so.0", "libGL.so.1")
    if library is None or not (context := _pointer(library.glXGetCurrentContext)):
        return None
    getters = (library.glXGetCurrentDisplay, library.glXGetCurrentDrawable)
    display, draw, read = map(_pointer, (*getters, library.glXGetCurrentReadDrawable))
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


def _osmesa_context() -> HostContext | None:
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

    def change(name: str, old: Any, new: Any, kind: Any = ctypes.c_int) -> None:
        back.append((kind, name, old))
        if new is not None:
            call(name, *new, kind=kind)

    for name, (capability, needed) in CAPABILITIES.items():
        if name != "SAMPLE_SHADING" or load("glMinSampleShading"):
            back.append((ctypes.c_int, _SWITCH[bool(is_enabled(capability))], (capability,)))
            call(_SWITCH[needed], capability)
    for name, leading, queries, needed_integers in STATE:
        if load(name):
            state = tuple(value for query in queries for value in state_of(*query))
            change(name, leading + state, needed_integers and leading + needed_integers)
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


Backend = Literal["auto", "egl", "osmesa", "native", "current"]

BACKENDS: tuple[Backend, ...] = ("auto", "egl", "osmesa", "native", "current")
# Backends that "auto" tries, in this order. Windows and macOS have only "native".
AUTO: tuple[Backend, ...] = (
    ("native",) if sys.platform in ("win32", "darwin") else ("egl", "osmesa")
)
_MESA = "libgl1 libgl1-mesa-dri"
REMEDIES = {
    "egl": f"on Debian or Ubuntu: {{sudo}}apt-get install libegl1 {_MESA}",
    "osmesa": "on Debian or Ubuntu: {sudo}apt-get install libosmesa6; Mesa 25.1 and later lack it: "
    "use egl",
    "native": "install a graphics driver that has OpenGL 3.3"
    if AUTO == ("native",)
    else f"on Debian or Ubuntu: {{sudo}}apt-get install {_MESA} libx11-6 xvfb",
    "current": "make a context current first, or use the backend auto",
}
SOFTWARE = ("llvmpipe", "softpipe", "swr", "swiftshader", "software rasterizer", "apple software")
_GL_VERSION = 330

# Names of the drivers that this process or its ancestors have opened. A fork does not copy a
# driver's threads, so _lost has the drivers opened before the last fork.
_opened: set[str] = set()
_lost: set[str] = set()


def _lose() -> None:
    if egl_in_use():  # also by other code
        _opened.add("egl")
    _lost.update(_opened)


def _after_fork() -> None:
    while (host := current_context()) is not None:
        _inherited.add(host.handle)
    _lose()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
if os.getpid() != IMPORTER:
    _lose()


class ForeignContext:
    """Access to the OpenGL functions of the host's current context, which only the host frees."""

    def __init__(self, get_proc_address: Any) -> None:
        get_proc_address.restype = ctypes.c_void_p
        get_proc_address.argtypes = [ctypes.c_char_p]
        self._get_proc_address = get_proc_address

    def load(self, name: str) -> int:
        return self._get_proc_address(name.encode()) or 0

    load_opengl_function = load

    def release(self) -> None:
        pass

    def __enter__(self) -> ForeignContext:
        return self

    def __exit__(self, *exception: object) -> None:
        pass


class _OSMesaContext(ForeignContext):
    """An off-screen Mesa context. Its default framebuffer is one pixel in memory; images are drawn
    into framebuffer objects."""

    _ATTRIBUTES = (
        *(0x22, 0x1908),  # OSMESA_FORMAT: RGBA
        *(0x30, 24),  # OSMESA_DEPTH_BITS
        *(0x33, 0x34),  # OSMESA_PROFILE: core
        *(0x36, _GL_VERSION // 100),  # OSMESA_CONTEXT_MAJOR_VERSION
        *(0x37, _GL_VERSION % 100 // 10),  # OSMESA_CONTEXT_MINOR_VERSION
        *(0, 0),
    )

    def __init__(self) -> None:
        self._library = _open_library("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
        super().__init__(self._library.OSMesaGetProcAddress)
        create = self._library.OSMesaCreateContextAttribs
        create.restype = ctypes.c_void_p
        create.argtypes = [ctypes.POINTER(ctypes.c_int), ctypes.c_void_p]
        self._context = create((ctypes.c_int * len(self._ATTRIBUTES))(*self._ATTRIBUTES), None)
        if not self._context:
            raise ContextError("libOSMesa refused an OpenGL 3.3 core context")
        self._pixel = (ctypes.c_ubyte * 4)()
        self._make_current(self._context)

    def _make_current(self, context: int | None) -> None:
        if not bind_osmesa(self._library, context, self._pixel if context else None, 1, 1):
            raise ContextError("libOSMesa could not make its context current")

    def __enter__(self) -> _OSMesaContext:
        self._make_current(self._context)
        return self

    def __exit__(self, *exception: object) -> None:
        self._make_current(None)

    def release(self) -> None:
        if self._context:
            self._library.OSMesaDestroyContext.argtypes = [ctypes.c_void_p]
            self._library.OSMesaDestroyContext(self._context)
            self._context = None


def check_process(process: int) -> None:
    """Raise ContextError if the process with this ID is not the current process, so that an object
    that it created was inherited by a fork."""
    if process != os.getpid():
        raise ContextError(
            "this renderer was created before a fork, in another process: create a new one in this "
            "process"
        )


def _open_library(*names: str) -> ctypes.CDLL:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise ContextError(f"{names[0]} is not installed")


def _standalone(backend: str, **libraries: str) -> Any:
    for library in libraries.values():
        _open_library(library)
    if "libx11" in libraries and not os.environ.get("DISPLAY"):
        raise ContextError("DISPLAY is not set: start an X server, such as Xvfb with xvfb-run")
    native = backend == "native"
    make = glcontext.default_backend() if native else glcontext.get_backend_by_name(backend)
    return make(mode="standalone", glversion=_GL_VERSION, **libraries)


def is_software(renderer: str) -> bool:
    """Return whether a value of GL_RENDERER names a software driver."""
    return any(name in renderer.lower() for name in SOFTWARE)


@dataclass(frozen=True)
class Context:
    """An OpenGL context with its properties.

    backend : "egl", "osmesa", "native" or "current"
    gl : the moderngl context; it is current only within :meth:`drawing`
    loader : object that returns the addresses of OpenGL functions
    handle : address of a host's context, otherwise 0
    renderer, version : GL_RENDERER and GL_VERSION, which every result and golden must record
    process : ID of the process that created the context; no other process can use the context
    """

    backend: str
    gl: moderngl.Context
    loader: Any
    handle: int
    renderer: str
    version: str
    process: int = field(default_factory=os.getpid)
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False, compare=False)

    @property
    def most_samples(self) -> int:
        """Largest number of samples per pixel that the driver supports."""
        return max(int(self.gl.info["GL_MAX_SAMPLES"]), 1)

    @property
    def max_side(self) -> int:
        """Largest width and height of an image that the driver supports, in pixels."""
        info = self.gl.info
        return int(min(info["GL_MAX_TEXTURE_SIZE"], *info["GL_MAX_VIEWPORT_DIMS"]))

    @property
    def software(self) -> bool:
        """Whether the driver is a software driver, which draws on the CPU."""
        return is_software(self.renderer)

    def function(self, name: str, *argument_types: type, result: type | None = None) -> Any:
        """Return an OpenGL function that moderngl does not wrap."""
        return ctypes.CFUNCTYPE(result, *argument_types)(self.loader.load(name))

    @contextmanager
    def drawing(self) -> Iterator[moderngl.Context]:
        """Make the context current, for one thread at a time.

        Afterwards the previous context is current again. If this is the host's context, the state
        of the context is restored. Raises ContextError if the context was released, was created
        before a fork, or is a host's context that is not current in this thread.
        """
        check_process(self.process)
        with self._lock:
            if self.released:
                raise ContextError("this renderer was released: create a new one")
            host, guest = current_context(), self.backend == "current"
            if guest and (host is None or host.handle != self.handle):
                raise ContextError(
                    "the context in which this renderer was created is not current in this "
                    "thread: make it current first"
                )
            restore = save_state(self.loader.load) if guest else host and host.rebind
            try:
                with nullcontext() if guest else self.gl:
                    yield self.gl
            finally:
                if restore:
                    restore()

    @property
    def inherited(self) -> bool:
        """Whether another process created the context, before a fork. Only that process may free
        the context."""
        return self.process != os.getpid()

    @property
    def released(self) -> bool:
        """Whether :meth:`release` was called."""
        return isinstance(self.gl.mglo, moderngl.InvalidObject)

    def release(self) -> None:
        """Free the context, unless it is the host's or inherited. Further calls have no effect."""
        if not self.inherited:
            self.gl.release()


# With these names, glcontext does not start ldconfig or a compiler to find the libraries.
_LIBRARIES = {} if AUTO == ("native",) else {"libgl": "libGL.so.1", "libx11": "libX11.so.6"}
_OPENERS: dict[str, Callable[[], Any]] = {
    "egl": partial(_standalone, "egl", libegl="libEGL.so.1", libgl="libGL.so.1"),
    "osmesa": _OSMesaContext,
    "native": partial(_standalone, "native", **_LIBRARIES),
}


def create_context(backend: Backend = "auto") -> Context:
    """Open an OpenGL 3.3 context.

    Parameters
    ----------
    backend : "egl", "osmesa", "native" (WGL, CGL or GLX), "current" (the host's context), or "auto"
        (default) for the first backend of AUTO that works

    Raises
    ------
    InputError : an unknown backend
    ContextError : no backend works; the message lists each backend's error, and a remedy
    """
    check_known("backend", backend, BACKENDS)
    tried = AUTO if backend == "auto" else (backend,)
    host = current_context()
    errors = []
    for name in tried:
        try:
            return _open(name, host)
        except Exception as error:  # glcontext raises bare Exception
            errors.append(f"{name}: {error}")
        finally:
            if host is not None and name != "current":
                host.rebind()
    raise ContextError(f"no OpenGL context ({'; '.join(errors)}); {_remedy(tried)}")


def _open(name: str, host: HostContext | None) -> Context:
    if name in _lost:
        raise ContextError("this driver was in use before this process was forked")
    guest = host if name == "current" else None
    if name == "current" and guest is None:
        raise ContextError("no EGL, GLX or OSMesa context is current in this thread")
    loader: Any = ForeignContext(guest.get_proc_address) if guest else _OPENERS[name]()
    restore = save_state(loader.load) if guest else None
    try:
        gl = moderngl.create_context(require=_GL_VERSION, standalone=not guest, context=loader)
        # If Python freed a GPU object while another context was current, OpenGL would delete that
        # context's object with the same number. context_gc delays deletions until gl.gc().
        gl.gc_mode = "context_gc"
        info = gl.info
    finally:
        if restore:
            restore()
    if not guest:
        with gl:
            pass  # leaving the block unbinds the new context
        _opened.add(name)
    handle = guest.handle if guest else 0
    return Context(name, gl, loader, handle, info["GL_RENDERER"], info["GL_VERSION"])


def _remedy(tried: tuple[str, ...]) -> str:
    if not _lost.isdisjoint(tried):
        return (
            'start the process by multiprocessing.get_context("spawn"), or a PyTorch loader with '
            'multiprocessing_context="spawn"'
        )
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    return REMEDIES[tried[0]].format(sudo="" if root else "sudo ")


@dataclass(frozen=True)
class Finding:
    """Result of :func:`probe` for one backend: properties of its context, or an error."""

    backend: str
    renderer: str = ""
    version: str = ""
    samples: int = 0
    size: int = 0
    error: str = ""


def probe() -> list[Finding]:
    """Try the backends "egl", "osmesa" and "native", and return the result of each."""
    findings = []
    for name in BACKENDS[1:-1]:
        try:
            context = create_context(name)
        except ContextError as error:
            findings.append(Finding(name, error=str(error)))
        else:
            limits = context.most_samples, context.max_side
            findings.append(Finding(name, context.renderer, context.version, *limits))
            context.release()
    return findings
