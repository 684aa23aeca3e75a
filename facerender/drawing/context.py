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
from functools import cached_property, partial
from typing import Any, Literal

import glcontext
import moderngl

from facerender.errors import ContextError, check_known
from facerender.system import IMPORTER


class ForeignContext:
    """An OpenGL context of a host program, current in this thread, which only the host frees.

    handle : address of the context, which identifies it
    rebind : function that makes the context current again, even if the window system regards it so
    """

    def __init__(
        self, get_proc_address: Any, handle: int = 0, rebind: Callable[[], object] = lambda: None
    ) -> None:
        get_proc_address.restype = ctypes.c_void_p
        get_proc_address.argtypes = [ctypes.c_char_p]
        self._get_proc_address, self.handle, self.rebind = get_proc_address, handle, rebind

    def load(self, name: str) -> int:
        return self._get_proc_address(name.encode()) or 0

    load_opengl_function = load

    def release(self) -> None:
        pass

    def __enter__(self) -> ForeignContext:
        return self

    def __exit__(self, *exception: object) -> None:
        pass


# Libraries that may have a current context, by the prefix of their functions.
_LIBRARIES = {
    "egl": ("libEGL.so.1",),
    "glX": ("libGLX.so.0", "libGL.so.1"),
    "OSMesa": ("libOSMesa.so.8",),
}


def current_context() -> ForeignContext | None:
    """Return the EGL, GLX or OSMesa context that is current in this thread, or None. One that was
    current before a fork is ignored: its driver's threads do not exist in the child process."""
    for prefix, names in _LIBRARIES.items():
        library = _loaded(*names)
        handle = library and _pointer(getattr(library, prefix + "GetCurrentContext"))
        if handle and handle not in _inherited:
            load = getattr(library, prefix + "GetProcAddress")
            return ForeignContext(load, handle, _rebinder(prefix, library, handle))
    return None


_inherited: set[int] = set()  # handles of contexts that were current before a fork
_libraries: dict[str, ctypes.CDLL] = {}


def _loaded(*names: str) -> ctypes.CDLL | None:
    """Return the first library in `names` that the process has already loaded, None on Windows. A
    library that is not loaded has no current context."""
    for name in names if sys.platform != "win32" else ():
        if name not in _libraries:
            try:  # CDLL would take twice as long for a library that is absent: each frame asks
                handle = ctypes._dlopen(name, os.RTLD_NOLOAD | os.RTLD_NOW)  # type: ignore[attr-defined]
            except OSError:
                continue
            _libraries[name] = ctypes.CDLL(name, handle=handle)
        return _libraries[name]
    return None


def _pointer(function: Any, *arguments: Any) -> int | None:
    function.restype = ctypes.c_void_p
    address: int | None = function(*arguments)
    return address


def _rebinder(prefix: str, library: Any, context: int) -> Callable[[], object]:
    """Return the function that makes the current context of a library current again."""
    if prefix == "OSMesa":
        width, height, layout = (ctypes.c_int() for _ in range(3))
        buffer = ctypes.c_void_p()
        outputs = [ctypes.byref(output) for output in (width, height, layout, buffer)]
        library.OSMesaGetColorBuffer(ctypes.c_void_p(context), *outputs)
        return lambda: _bind_osmesa(library, context, buffer, width.value, height.value)
    display = _pointer(getattr(library, prefix + "GetCurrentDisplay"))
    if prefix == "egl":
        make_current, getter = library.eglMakeCurrent, library.eglGetCurrentSurface
        surfaces = [_pointer(getter, name) for name in (0x3059, 0x305A)]
    else:
        make_current = library.glXMakeContextCurrent
        names = "glXGetCurrentDrawable", "glXGetCurrentReadDrawable"
        surfaces = [_pointer(getattr(library, name)) for name in names]
    make_current.argtypes = [ctypes.c_void_p] * 4

    def rebind() -> None:
        make_current(display, None, None, None)
        make_current(display, *surfaces, context)

    return rebind


def egl_in_use() -> bool:
    """Return whether any code in this process has initialised an EGL device display."""
    library = _loaded("libEGL.so.1")
    if library is None:
        return False
    names = b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT"
    functions: list[Any] = [_pointer(library.eglGetProcAddress, name) for name in names]
    if not all(functions):
        return False
    pointers = ctypes.c_void_p, ctypes.c_void_p
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, *pointers)(functions[0])
    get = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, *pointers)(functions[1])
    devices, count = (ctypes.c_void_p * 16)(), ctypes.c_int()
    query(len(devices), devices, ctypes.byref(count))
    library.eglQueryString.argtypes = [ctypes.c_void_p, ctypes.c_int]
    # 0x3054 is EGL_VERSION: only an initialised display has a version.
    return any(
        _pointer(library.eglQueryString, get(0x313F, device, None), 0x3054)
        for device in devices[: count.value]
    )


def _bind_osmesa(
    library: Any, context: int | None, buffer: Any, width: int = 1, height: int = 1
) -> bool:
    """Make an OSMesa context current with a buffer of RGBA bytes. If `context` is None, unbind the
    current context. Return whether OSMesa succeeded."""
    make_current = library.OSMesaMakeCurrent
    make_current.argtypes = [ctypes.c_void_p, ctypes.c_void_p] + [ctypes.c_int] * 3
    unsigned_byte = 0x1401
    return bool(make_current(context, buffer, unsigned_byte, width, height))


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

# State: (setter, its leading arguments, queries for its other arguments, values that
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
    *(("glPixelStorei", (name,), ((name, 1),), None) for name in (0x0D05, 0x0CF5)),  # alignments
    ("glClearColor", (), ((0x0C22, 4),), None),
    ("glDepthRange", (), ((0x0B70, 2),), (0, 1)),
)
# Argument types of setters; others take integers.
_FLOATS = {"glClearColor": ctypes.c_float, "glDepthRange": ctypes.c_double}
_SWITCH = ("glDisable", "glEnable")
_TEXTURE_0, _ACTIVE_TEXTURE, _MAX_UNITS = 0x84C0, 0x84E0, 0x8B4D
# (texture target, query of the bound texture) for 2D textures and 2D multisample textures.
_TEXTURES = ((0x0DE1, 0x8069), (0x9100, 0x9104))
_SAMPLER_BINDING = 0x8919
# Texture units that every driver has for a fragment shader. Drawing uses up to 14: maps, triangle
# table, passes, shadow maps, environment.
_UNITS = 16


@contextmanager
def saved_state(load: Callable[[str], int]) -> Iterator[None]:
    """Save the state of the current context, set what drawing needs, and restore it afterwards.

    load : function that returns the address of an OpenGL function, 0 if the driver lacks it
    """

    def function(name: str, *arguments: Any, result: Any = None) -> Any:
        return ctypes.CFUNCTYPE(result, *arguments)(load(name))

    get = function("glGetDoublev", ctypes.c_int, ctypes.c_void_p)
    is_enabled = function("glIsEnabled", ctypes.c_int, result=ctypes.c_ubyte)
    values = (ctypes.c_double * 4)()

    def state_of(name: int, count: int = 1) -> list[float]:
        get(name, values)
        return values[:count]

    def call(name: str, *arguments: float) -> None:
        argument_type = _FLOATS.get(name, ctypes.c_int)
        numbers = map(int, arguments) if argument_type is ctypes.c_int else arguments
        function(name, *[argument_type] * len(arguments))(*numbers)

    back: list[tuple[str, tuple[float, ...]]] = []

    def change(name: str, old: tuple[float, ...], new: tuple[float, ...] | None) -> None:
        back.append((name, old))
        if new is not None:
            call(name, *new)

    for name, (capability, needed) in CAPABILITIES.items():
        if name != "SAMPLE_SHADING" or load("glMinSampleShading"):
            back.append((_SWITCH[bool(is_enabled(capability))], (capability,)))
            call(_SWITCH[needed], capability)
    for name, leading, queries, needed_values in STATE:
        if load(name):
            state = (value for query in queries for value in state_of(*query))
            change(name, (*leading, *state), needed_values and leading + needed_values)
    active = state_of(_ACTIVE_TEXTURE)
    # moderngl binds each new texture to the last unit.
    for unit in (*range(_UNITS), int(*state_of(_MAX_UNITS)) - 1):
        change("glActiveTexture", (_TEXTURE_0 + unit,), (_TEXTURE_0 + unit,))
        for target, binding in _TEXTURES:
            back.append(("glBindTexture", (target, *state_of(binding))))
        change("glBindSampler", (unit, *state_of(_SAMPLER_BINDING)), (unit, 0))
    back.append(("glActiveTexture", (*active,)))

    try:
        yield
    finally:
        for name, arguments in back:
            call(name, *arguments)


Backend = Literal["auto", "egl", "osmesa", "native", "current"]

BACKENDS: tuple[Backend, ...] = ("auto", "egl", "osmesa", "native", "current")
# Backends that "auto" tries, in this order. Windows and macOS have only "native".
_OTHER_SYSTEM = sys.platform in ("win32", "darwin")
AUTO: tuple[Backend, ...] = ("native",) if _OTHER_SYSTEM else ("egl", "osmesa")
_APT, _MESA = "on Debian or Ubuntu: {sudo}apt-get install", "libgl1 libgl1-mesa-dri"
_DRIVER = "install a graphics driver that has OpenGL 3.3"
REMEDIES = {
    "egl": f"{_APT} libegl1 {_MESA}",
    "osmesa": f"{_APT} libosmesa6; Mesa 25.1 and later lack it: use egl",
    "native": _DRIVER if _OTHER_SYSTEM else f"{_APT} {_MESA} libx11-6 xvfb",
    "current": "make a context current first, or use the backend auto",
}
SOFTWARE = ("llvmpipe", "softpipe", "swr", "swiftshader", "software rasterizer", "apple software")
_GL_VERSION = 330
_DEVICE = "GLCONTEXT_DEVICE_INDEX"  # variable by which glcontext chooses among EGL devices

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


class _OSMesaContext(ForeignContext):
    """An off-screen Mesa context. Its default framebuffer, which is not used, is one pixel."""

    def __init__(self) -> None:
        self._library: Any = _open_library("libOSMesa.so.8", "libOSMesa.so")
        super().__init__(self._library.OSMesaGetProcAddress)
        attributes = (
            *(0x22, 0x1908),  # OSMESA_FORMAT: RGBA
            *(0x30, 24),  # OSMESA_DEPTH_BITS
            *(0x33, 0x34),  # OSMESA_PROFILE: core
            *(0x36, _GL_VERSION // 100),  # OSMESA_CONTEXT_MAJOR_VERSION
            *(0x37, _GL_VERSION % 100 // 10),  # OSMESA_CONTEXT_MINOR_VERSION
            *(0, 0),
        )
        array = (ctypes.c_int * len(attributes))(*attributes)
        self._context = _pointer(self._library.OSMesaCreateContextAttribs, array, None)
        if not self._context:
            raise ContextError("libOSMesa refused an OpenGL 3.3 core context")
        self._pixel = (ctypes.c_ubyte * 4)()
        self.__enter__()

    def __enter__(self) -> _OSMesaContext:
        if not _bind_osmesa(self._library, self._context, self._pixel):
            raise ContextError("libOSMesa could not make its context current")
        return self

    def __exit__(self, *exception: object) -> None:
        _bind_osmesa(self._library, None, None)

    def release(self) -> None:
        self._library.OSMesaDestroyContext.argtypes = [ctypes.c_void_p]
        self._library.OSMesaDestroyContext(self._context)


def check_process(process: int) -> None:
    """Raise ContextError if this process was forked from the process with this ID."""
    if process != os.getpid():
        cause = "this renderer was created before a fork, in another process"
        raise ContextError(f"{cause}: create a new one in this process")


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


@dataclass(frozen=True)
class Context:
    """An OpenGL context with its properties.

    gl : the moderngl context; it is current only within :meth:`drawing`
    loader : object that returns the addresses of OpenGL functions; a ForeignContext for "current"
    renderer, version : GL_RENDERER and GL_VERSION, which every result and golden must record
    process : ID of the process that created the context; no other process can use the context
    """

    backend: str
    gl: moderngl.Context
    loader: Any
    renderer: str
    version: str
    process: int = field(default_factory=os.getpid)
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False, compare=False)

    @cached_property
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
        return any(name in self.renderer.lower() for name in SOFTWARE)

    @contextmanager
    def drawing(self) -> Iterator[moderngl.Context]:
        """Make the context current, for one thread at a time.

        Afterwards the previous context is current again. If this is the host's context, the state
        of the context is restored. Raises ContextError if the context was released, was created
        before a fork, or is a host's context that is not current in this thread.
        """
        check_process(self.process)
        with self._lock:
            if isinstance(self.gl.mglo, moderngl.InvalidObject):
                raise ContextError("this renderer was released: create a new one")
            host, guest = current_context(), self.backend == "current"
            if guest and (host is None or host.handle != self.loader.handle):
                cause = "the context in which this renderer was created is not current"
                raise ContextError(f"{cause} in this thread: make it current first")
            try:
                with saved_state(self.loader.load) if guest else self.gl:
                    yield self.gl
            finally:
                if host and not guest:
                    host.rebind()

    @property
    def closed(self) -> bool:
        """Whether the context was released, or belongs to another process, which may free it."""
        return self.process != os.getpid() or isinstance(self.gl.mglo, moderngl.InvalidObject)

    def release(self, free: Callable[[], object] | None = None) -> None:
        """Free the context, unless it is the host's or inherited. Further calls have no effect.

        free : frees objects of the context, which is current during the call
        """
        if not self.closed:
            if free:
                with self.drawing():
                    free()
            self.gl.release()


# With these names, glcontext does not start ldconfig or a compiler to find the libraries.
_X11 = {} if _OTHER_SYSTEM else {"libgl": "libGL.so.1", "libx11": "libX11.so.6"}
_OPENERS: dict[str, Callable[[], Any]] = {
    "egl": partial(_standalone, "egl", libegl="libEGL.so.1", libgl="libGL.so.1"),
    "osmesa": _OSMesaContext,
    "native": partial(_standalone, "native", **_X11),
}


def create_context(backend: Backend = "auto") -> Context:
    """Open an OpenGL 3.3 context.

    Parameters
    ----------
    backend : "egl", "osmesa", "native" (WGL, CGL or GLX), "current" (the host's context), or "auto"
        (default) for the first backend of AUTO that works. If the environment variable
        GLCONTEXT_DEVICE_INDEX chooses one of several GPUs, "auto" uses EGL

    Raises
    ------
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
            if name == "egl" and _DEVICE in os.environ:
                break  # the other backends ignore the choice
        finally:
            if host is not None and name != "current":
                host.rebind()
    raise ContextError(f"no OpenGL context ({'; '.join(errors)}); {_remedy(tried)}")


def _open(name: str, host: ForeignContext | None) -> Context:
    if name in _lost:
        raise ContextError("this driver was in use before this process was forked")
    guest = name == "current"
    if guest and host is None:
        raise ContextError("no EGL, GLX or OSMesa context is current in this thread")
    loader: Any = host if guest else _OPENERS[name]()
    with saved_state(loader.load) if guest else nullcontext():
        gl = moderngl.create_context(require=_GL_VERSION, standalone=not guest, context=loader)
        # If Python freed a GPU object while another context was current, OpenGL would delete that
        # context's object with the same number. context_gc delays deletions until gl.gc().
        gl.gc_mode = "context_gc"
        info = gl.info
    if not guest:
        with gl:
            pass  # leaving the block unbinds the new context
        _opened.add(name)
    return Context(name, gl, loader, info["GL_RENDERER"], info["GL_VERSION"])


def _remedy(tried: tuple[str, ...]) -> str:
    if not _lost.isdisjoint(tried):
        start = 'start the process by multiprocessing.get_context("spawn")'
        return f'{start}, or a PyTorch loader with multiprocessing_context="spawn"'
    chosen = ""
    if tried[0] == "egl" and (index := os.environ.get(_DEVICE)) is not None:
        chosen = f"{_DEVICE} = {index}: give the index of a GPU, or unset it; "
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    return chosen + REMEDIES[tried[0]].format(sudo="" if root else "sudo ")


def probe() -> list[dict[str, Any]]:
    """Try the backends "egl", "osmesa" and "native"; return the properties or the error of each."""
    findings, keys = [], ("renderer", "version", "samples", "size", "error")
    for name in BACKENDS[1:-1]:
        values: tuple[Any, ...] = "", "", 0, 0, ""
        try:
            context = create_context(name)
            values = context.renderer, context.version, context.most_samples, context.max_side, ""
            context.release()
        except ContextError as error:
            values = *values[:-1], str(error)
        findings.append({"backend": name, **dict(zip(keys, values, strict=True))})
    return findings
