"""An OpenGL 3.3 context without a window: EGL, OSMesa, or the one that the host has current."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import glcontext
import moderngl

from facerender.errors import ContextError, InputError

Backend = Literal["auto", "egl", "osmesa", "current"]

BACKENDS: tuple[Backend, ...] = ("auto", "egl", "osmesa", "current")
PACKAGES = {"egl": "libegl1 libgl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
_GL_VERSION = 330


class _Loader(Protocol):
    """The object behind a moderngl context."""

    def load(self, name: str) -> int: ...


class _ForeignContext:
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

    def __enter__(self) -> _ForeignContext:
        return self

    def __exit__(self, *exception: object) -> None:
        pass


class _OSMesaContext(_ForeignContext):
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
        make_current = self._library.OSMesaMakeCurrent
        make_current.argtypes = [ctypes.c_void_p, ctypes.c_void_p] + [ctypes.c_int] * 3
        unsigned_byte = 0x1401
        pixel = self._pixel if context else None
        if not make_current(context, pixel, unsigned_byte, 1, 1):
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


def _open_library(*names: str) -> ctypes.CDLL:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise ContextError(f"{names[0]} is not installed")


def _egl() -> _Loader:
    for library in ("libEGL.so.1", "libGL.so.1"):
        _open_library(library)
    # With the names given, glcontext starts no ldconfig and no compiler to look for them.
    loader: _Loader = glcontext.get_backend_by_name("egl")(
        mode="standalone", glversion=_GL_VERSION, libegl="libEGL.so.1", libgl="libGL.so.1"
    )
    return loader


def _current() -> _Loader:
    for names, current, get_proc_address in (
        (("libEGL.so.1",), "eglGetCurrentContext", "eglGetProcAddress"),
        (("libGL.so.1", "libGLX.so.0"), "glXGetCurrentContext", "glXGetProcAddressARB"),
        (("libOSMesa.so.8",), "OSMesaGetCurrentContext", "OSMesaGetProcAddress"),
    ):
        try:
            library = _open_library(*names)
        except ContextError:
            continue
        get_current = getattr(library, current)
        get_current.restype = ctypes.c_void_p
        if get_current():
            return _ForeignContext(getattr(library, get_proc_address))
    raise ContextError("no EGL, GLX or OSMesa context is current in this thread")


@dataclass(frozen=True)
class Context:
    """An OpenGL context that works, and what it is; ``with context.gl:`` makes it current.

    Attributes
    ----------
    backend : "egl", "osmesa" or "current"
    gl : the moderngl context
    renderer, version : GL_RENDERER and GL_VERSION, to be recorded with every figure and golden
    """

    backend: str
    gl: moderngl.Context
    loader: _Loader
    renderer: str
    version: str

    def function(self, name: str, *argument_types: type, result: type | None = None) -> Any:
        """Return an OpenGL function that moderngl does not wrap."""
        return ctypes.CFUNCTYPE(result, *argument_types)(self.loader.load(name))

    @contextmanager
    def drawing(self) -> Iterator[moderngl.Context]:
        """Make the context current; a host's finds its state as it was afterwards."""
        with self.gl as gl:
            if self.backend != "current":
                yield gl
                return
            restore = _put_aside_state(self)
            try:
                yield gl
            finally:
                restore()

    def release(self) -> None:
        """Free the context, unless it is the host's."""
        self.gl.release()


# What drawing needs to be off, but a host may have enabled.
_CAPABILITIES = {
    "BLEND": 0x0BE2,
    "CULL_FACE": 0x0B44,
    "DEPTH_TEST": 0x0B71,
    "SCISSOR_TEST": 0x0C11,
    "STENCIL_TEST": 0x0B90,
    "POLYGON_OFFSET_FILL": 0x8037,
    "FRAMEBUFFER_SRGB": 0x8DB9,
    "RASTERIZER_DISCARD": 0x8C89,
    "PRIMITIVE_RESTART": 0x8F9D,
    "SAMPLE_ALPHA_TO_COVERAGE": 0x809E,
    "SAMPLE_COVERAGE": 0x80A0,
}
_TEXTURE_0, _TEXTURE_2D, _TEXTURE_BINDING_2D, _ACTIVE_TEXTURE = 0x84C0, 0x0DE1, 0x8069, 0x84E0
_FILL, _FRONT_AND_BACK, _LESS, _COUNTER_CLOCKWISE = 0x1B02, 0x0408, 0x0201, 0x0901


def _put_aside_state(context: Context) -> Callable[[], None]:
    """Bring a host's state to what drawing needs, and return the way back."""
    integer, pointer = ctypes.c_int, ctypes.c_void_p
    get_integers = context.function("glGetIntegerv", integer, pointer)
    is_enabled = context.function("glIsEnabled", integer, result=ctypes.c_ubyte)
    switch = (
        context.function("glDisable", integer),
        context.function("glEnable", integer),
    )

    def saved(name: int, count: int = 1) -> tuple[int, ...]:
        values = (integer * count)()
        get_integers(name, values)
        return tuple(values)

    def call(name: str, *values: int) -> Callable[[], None]:
        function = context.function(name, *[integer] * len(values))
        return lambda: function(*values)

    enabled = {each: bool(is_enabled(each)) for each in _CAPABILITIES.values()}
    units = [*range(4), context.gl.max_texture_units - 1]  # moderngl uploads through the last
    active = saved(_ACTIVE_TEXTURE)
    back = [
        call("glBindFramebuffer", 0x8CA9, *saved(0x8CA6)),  # draw
        call("glBindFramebuffer", 0x8CA8, *saved(0x8CAA)),  # read
        call("glViewport", *saved(0x0BA2, 4)),
        call("glScissor", *saved(0x0C10, 4)),
        call("glUseProgram", *saved(0x8B8D)),
        call("glBindVertexArray", *saved(0x85B5)),
        call("glBindBuffer", 0x8892, *saved(0x8894)),  # array buffer
        call("glBindRenderbuffer", 0x8D41, *saved(0x8CA7)),
        call("glPixelStorei", 0x0CF5, *saved(0x0CF5)),  # unpack alignment
        call("glPixelStorei", 0x0D05, *saved(0x0D05)),  # pack alignment
        call("glFrontFace", *saved(0x0B46)),
        call("glDepthFunc", *saved(0x0B74)),
        call("glDepthMask", *saved(0x0B72)),
        call("glColorMask", *saved(0x0C23, 4)),
        call("glPolygonMode", _FRONT_AND_BACK, *saved(0x0B40)),
    ]
    for unit in units:
        call("glActiveTexture", _TEXTURE_0 + unit)()
        back.append(call("glActiveTexture", _TEXTURE_0 + unit))
        back.append(call("glBindTexture", _TEXTURE_2D, *saved(_TEXTURE_BINDING_2D)))
    back.append(call("glActiveTexture", *active))

    for each in enabled:
        switch[False](each)
    call("glFrontFace", _COUNTER_CLOCKWISE)()
    call("glDepthFunc", _LESS)()
    call("glPolygonMode", _FRONT_AND_BACK, _FILL)()

    def restore() -> None:
        for action in back:
            action()
        for each, was_enabled in enabled.items():
            switch[was_enabled](each)

    return restore


_OPENERS: dict[str, Callable[[], Any]] = {
    "egl": _egl,
    "osmesa": _OSMesaContext,
    "current": _current,
}


def create_context(backend: Backend = "auto") -> Context:
    """Open an OpenGL 3.3 context.

    Parameters
    ----------
    backend : "auto" tries EGL, then OSMesa; "current" takes the host's

    Raises
    ------
    InputError : an unknown backend
    ContextError : none works; the message says what was tried, what each said, and the remedy
    """
    if backend not in BACKENDS:
        raise InputError(f"unknown backend {backend!r}; known: {', '.join(BACKENDS)}")
    tried = ("egl", "osmesa") if backend == "auto" else (backend,)
    said = []
    for name in tried:
        try:
            loader = _OPENERS[name]()
            gl = moderngl.create_context(
                require=_GL_VERSION, standalone=name != "current", context=loader
            )
        except Exception as error:  # glcontext raises bare Exception
            said.append(f"{name}: {error}")
            continue
        # An OpenGL object that Python drops in another context would free a stranger there.
        gl.gc_mode = "context_gc"
        info = gl.info
        return Context(name, gl, loader, info["GL_RENDERER"], info["GL_VERSION"])
    raise ContextError(f"no OpenGL context ({'; '.join(said)}); {_remedy(tried)}")


def _remedy(tried: tuple[str, ...]) -> str:
    if tried == ("current",):
        return "make a context current first, or use the backend auto"
    packages = " ".join(PACKAGES[name] for name in tried)
    sudo = "" if hasattr(os, "geteuid") and os.geteuid() == 0 else "sudo "
    return f"on Debian or Ubuntu: {sudo}apt-get install {packages}"


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
    """Try EGL and OSMesa, one after the other, and tell what each offers or lacks."""
    findings = []
    names: tuple[Backend, ...] = ("egl", "osmesa")
    for name in names:
        try:
            context = create_context(name)
        except ContextError as error:
            findings.append(Finding(name, error=str(error)))
            continue
        limits = context.gl.info
        findings.append(
            Finding(
                name,
                context.renderer,
                context.version,
                context.gl.max_samples,
                min(limits["GL_MAX_TEXTURE_SIZE"], *limits["GL_MAX_VIEWPORT_DIMS"]),
            )
        )
        context.release()
    return findings
