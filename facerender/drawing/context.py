"""An OpenGL 3.3 context without a window: EGL, OSMesa, the window system's (WGL, CGL, GLX), or the
one that the host has current. What a process has after a fork is told here as well."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import glcontext
import moderngl

from facerender.drawing.gl_state import (
    HostContext,
    bind_osmesa,
    current_context,
    egl_in_use,
    save_state,
)
from facerender.errors import ContextError, InputError, shown
from facerender.system import IMPORTER

Backend = Literal["auto", "egl", "osmesa", "native", "current"]

BACKENDS: tuple[Backend, ...] = ("auto", "egl", "osmesa", "native", "current")
# In the order in which auto tries them: elsewhere than on Linux there is the window system's alone.
AUTO: tuple[Backend, ...] = (
    ("native",) if sys.platform in ("win32", "darwin") else ("egl", "osmesa")
)
_MESA = "libgl1 libgl1-mesa-dri"
REMEDIES = {
    "egl": f"on Debian or Ubuntu: {{sudo}}apt-get install libegl1 {_MESA}",
    "osmesa": "on Debian or Ubuntu: {sudo}apt-get install libosmesa6; Mesa 25.1 has none: use egl",
    "native": "install a graphics driver that has OpenGL 3.3"
    if AUTO == ("native",)
    else f"on Debian or Ubuntu: {{sudo}}apt-get install {_MESA} libx11-6 xvfb",
    "current": "make a context current first, or use the backend auto",
}
SOFTWARE = ("llvmpipe", "softpipe", "swr", "swiftshader", "software rasterizer", "apple software")
_GL_VERSION = 330

# Drivers that this process, and those that it was forked from, have opened: whether the CPU draws.
# A driver's threads do not survive a fork: what was opened before the last one is lost.
_opened: dict[str, bool] = {}
_lost: dict[str, bool] = {}
_FORKED = "it was in use before this process was forked"


def _lose() -> None:
    if "egl" not in _opened and egl_in_use():  # somebody else's
        _opened["egl"] = True
    _lost.update(_opened)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_lose)
if os.getpid() != IMPORTER:
    _lose()


class _Loader(Protocol):
    """The object behind a moderngl context."""

    def load(self, name: str) -> int: ...


class ForeignContext:
    """A context that is current and stays the host's: only its functions are looked up."""

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
    """An off-screen Mesa context of our own, drawing into one pixel of ordinary memory;
    everything real is drawn into framebuffer objects."""

    _ATTRIBUTES = (
        (0x22, 0x1908),  # OSMESA_FORMAT: RGBA
        (0x30, 24),  # OSMESA_DEPTH_BITS
        (0x33, 0x34),  # OSMESA_PROFILE: core
        (0x36, _GL_VERSION // 100),  # OSMESA_CONTEXT_MAJOR_VERSION
        (0x37, _GL_VERSION % 100 // 10),  # OSMESA_CONTEXT_MINOR_VERSION
        (0, 0),
    )

    def __init__(self) -> None:
        _check_not_lost("osmesa")
        self._library = _open_library("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
        super().__init__(self._library.OSMesaGetProcAddress)
        flat = [value for pair in self._ATTRIBUTES for value in pair]
        create = self._library.OSMesaCreateContextAttribs
        create.restype = ctypes.c_void_p
        create.argtypes = [ctypes.POINTER(ctypes.c_int), ctypes.c_void_p]
        self._context = create((ctypes.c_int * len(flat))(*flat), None)
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


class _SurfacelessContext(ForeignContext):
    """A context of a display of Mesa's that is not the one which other EGL contexts share, and so
    has a software driver of its own, whose threads run."""

    driver = "surfaceless"
    _PLATFORM_SURFACELESS, _OPENGL_API = 0x31DD, 0x30A2
    _CONFIG = (0x3033, 0, 0x3040, 8, 0x3038)  # any surface type; renders OpenGL
    _ATTRIBUTES = (0x3098, _GL_VERSION // 100, 0x30FB, _GL_VERSION % 100 // 10, 0x30FD, 1, 0x3038)

    def __init__(self) -> None:
        self._library = _open_library("libEGL.so.1")
        super().__init__(self._library.eglGetProcAddress)
        config, count = ctypes.c_void_p(), ctypes.c_int()
        self._display = self._egl("GetPlatformDisplay", self._PLATFORM_SURFACELESS, None, None)
        self._egl("Initialize", self._display, None, None)
        self._egl("BindAPI", self._OPENGL_API)
        wanted = (ctypes.c_int * len(self._CONFIG))(*self._CONFIG)
        found = ctypes.byref(config), 1, ctypes.byref(count)
        self._egl("ChooseConfig", self._display, wanted, *found)
        attributes = (ctypes.c_int * len(self._ATTRIBUTES))(*self._ATTRIBUTES)
        self._context = self._egl("CreateContext", self._display, config, None, attributes)
        self._egl("MakeCurrent", self._display, None, None, self._context)

    def _egl(self, name: str, *arguments: Any) -> ctypes.c_void_p:
        """Call a function, none of which returns 0 where all is well."""
        function = getattr(self._library, f"egl{name}")
        function.restype = ctypes.c_void_p
        if not (result := function(*arguments)):
            raise ContextError(f"{_FORKED}, and egl{name} failed for another display")
        return ctypes.c_void_p(result)

    def __enter__(self) -> _SurfacelessContext:
        self._egl("MakeCurrent", self._display, None, None, self._context)
        return self

    def __exit__(self, *exception: object) -> None:
        self._egl("MakeCurrent", self._display, None, None, None)

    def release(self) -> None:
        self._egl("DestroyContext", self._display, self._context)


def check_process(process: int) -> None:
    """Raise ContextError where what was made in this process is of no use here."""
    if process != os.getpid():
        raise ContextError(
            "this renderer was made in the process that this one was forked from: make a new one "
            "here"
        )


def _check_not_lost(driver: str) -> None:
    if driver in _lost:
        raise ContextError(_FORKED)


def _open_library(*names: str) -> ctypes.CDLL:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise ContextError(f"{names[0]} is not installed")


def _egl() -> _Loader:
    if _lost.get("egl") and _SurfacelessContext.driver not in _lost:
        return _SurfacelessContext()
    _check_not_lost("egl")
    for library in ("libEGL.so.1", "libGL.so.1"):
        _open_library(library)
    # With the names given, glcontext starts no ldconfig and no compiler to look for them.
    loader: _Loader = glcontext.get_backend_by_name("egl")(
        mode="standalone", glversion=_GL_VERSION, libegl="libEGL.so.1", libgl="libGL.so.1"
    )
    return loader


def _native() -> _Loader:
    _check_not_lost("native")
    libraries = {} if AUTO == ("native",) else {"libgl": "libGL.so.1", "libx11": "libX11.so.6"}
    for library in libraries.values():
        _open_library(library)
    if libraries and not os.environ.get("DISPLAY"):
        raise ContextError("DISPLAY names no X server: start one, such as Xvfb by xvfb-run")
    loader: _Loader = glcontext.default_backend()(
        mode="standalone", glversion=_GL_VERSION, **libraries
    )
    return loader


def _current() -> _Loader:
    host = current_context()
    if host is None:
        raise ContextError("no EGL, GLX or OSMesa context is current in this thread")
    return ForeignContext(host.get_proc_address)


def is_software(renderer: str) -> bool:
    """Tell from GL_RENDERER whether the CPU draws."""
    return any(name in renderer.lower() for name in SOFTWARE)


@dataclass(frozen=True)
class Context:
    """An OpenGL context that works, and what it is.

    Attributes
    ----------
    backend : "egl", "osmesa", "native" or "current"
    gl : the moderngl context; current within :meth:`drawing` alone
    handle : of a host's context
    renderer, version : GL_RENDERER and GL_VERSION, to be recorded with every figure and golden
    process : in which it was made, and alone can be used
    """

    backend: str
    gl: moderngl.Context
    loader: _Loader
    handle: int
    renderer: str
    version: str
    process: int = field(default_factory=os.getpid)
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False, compare=False)

    @property
    def most_samples(self) -> int:
        """How many samples a pixel can have."""
        return max(int(self.gl.info["GL_MAX_SAMPLES"]), 1)

    @property
    def software(self) -> bool:
        """Whether the CPU draws."""
        return is_software(self.renderer)

    def function(self, name: str, *argument_types: type, result: type | None = None) -> Any:
        """Return an OpenGL function that moderngl does not wrap."""
        return ctypes.CFUNCTYPE(result, *argument_types)(self.loader.load(name))

    @contextmanager
    def drawing(self) -> Iterator[moderngl.Context]:
        """Make the context current, and afterwards what was current before; a host's own context
        finds its state as it was. Other threads wait for their turn.

        Raises
        ------
        ContextError : the context was released, or made in the process that this one was forked
            from, or the host's is not current in this thread
        """
        check_process(self.process)
        with self._lock:
            if self.released:
                raise ContextError("this renderer was released: make a new one")
            host = current_context()
            if self.backend == "current":
                if host is None or host.handle != self.handle:
                    raise ContextError(
                        "the context in which this renderer was made is not current in this "
                        "thread: make it current first"
                    )
                restore = save_state(self.loader.load)
                try:
                    yield self.gl
                finally:
                    restore()
                return
            try:
                with self.gl:
                    yield self.gl
            finally:
                if host is not None:
                    host.rebind()

    @property
    def inherited(self) -> bool:
        """Whether it is of the process that this one was forked from, which alone may free it."""
        return self.process != os.getpid()

    @property
    def released(self) -> bool:
        """Whether :meth:`release` was called."""
        return isinstance(self.gl.mglo, moderngl.InvalidObject)

    def release(self) -> None:
        """Free the context, unless it is the host's or inherited; a second time does nothing."""
        if not self.inherited:
            self.gl.release()


_OPENERS: dict[str, Callable[[], Any]] = {
    "egl": _egl,
    "osmesa": _OSMesaContext,
    "native": _native,
    "current": _current,
}


def create_context(backend: Backend = "auto") -> Context:
    """Open an OpenGL 3.3 context.

    Parameters
    ----------
    backend : "auto" tries those of AUTO; "native" is WGL, CGL or GLX; "current" takes the host's

    Raises
    ------
    InputError : an unknown backend
    ContextError : none works; the message says what was tried, what each said, and the remedy
    """
    if str(backend) not in BACKENDS:
        raise InputError(f"unknown backend {shown(backend)}; known: {', '.join(BACKENDS)}")
    tried = AUTO if backend == "auto" else (backend,)
    host = current_context()
    said = []
    for name in tried:
        try:
            return _open(name, host)
        except Exception as error:  # glcontext raises bare Exception
            said.append(f"{name}: {error}")
        finally:
            if host is not None and name != "current":
                host.rebind()
    raise ContextError(f"no OpenGL context ({'; '.join(said)}); {_remedy(tried)}")


def _open(name: str, host: HostContext | None) -> Context:
    loader = _OPENERS[name]()
    guest = host if name == "current" else None
    restore = save_state(loader.load) if guest else None
    try:
        gl = moderngl.create_context(require=_GL_VERSION, standalone=not guest, context=loader)
        # An OpenGL object that Python drops in another context would free a stranger there.
        gl.gc_mode = "context_gc"
        info = gl.info
    finally:
        if restore:
            restore()
    if not guest:
        with gl:
            pass  # on the way out no context of ours stays current
    handle = guest.handle if guest else 0
    if not guest:
        _opened[getattr(loader, "driver", name)] = is_software(info["GL_RENDERER"])
    return Context(name, gl, loader, handle, info["GL_RENDERER"], info["GL_VERSION"])


def _remedy(tried: tuple[str, ...]) -> str:
    if not _lost.keys().isdisjoint(tried):
        return "start processes by spawn or forkserver (multiprocessing.get_context), not by fork"
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    return REMEDIES[tried[0]].format(sudo="" if root else "sudo ")


@dataclass(frozen=True)
class Finding:
    """What :func:`probe` found of one backend: a context's facts, or why there is none."""

    backend: str
    renderer: str = ""
    version: str = ""
    samples: int = 0
    size: int = 0
    error: str = ""


def probe() -> list[Finding]:
    """Try every backend of our own, one after the other, and tell what each offers or lacks."""
    findings = []
    for name in BACKENDS[1:-1]:
        try:
            context = create_context(name)
        except ContextError as error:
            findings.append(Finding(name, error=str(error)))
            continue
        with context.drawing() as gl:
            size = min(gl.info["GL_MAX_TEXTURE_SIZE"], *gl.info["GL_MAX_VIEWPORT_DIMS"])
            samples = gl.max_samples
        findings.append(Finding(name, context.renderer, context.version, samples, size))
        context.release()
    return findings
