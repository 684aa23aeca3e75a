"""The renderer, which draws the passes of a scene and reads the image back as float32."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Hashable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender import __version__
from facerender.drawing.compiled import CompiledFrame, sized
from facerender.drawing.context import Backend, create_context
from facerender.drawing.frame import (
    Frame,
    GBuffer,
    LazyMetadata,
    check_image,
    data_view,
    in_order,
    scene_metadata,
    shading_metadata,
)
from facerender.drawing.frame_passes import (
    Layer,
    Structure,
    can_defer,
    deferred_is_cheaper,
    fraction_passes,
    image_passes,
    surface_images,
    surface_passes,
    triangle_pass,
)
from facerender.drawing.motion import check_before, motion_vectors, pixel_centres
from facerender.drawing.passes import Pass, Target
from facerender.drawing.prepare import (
    Appearance,
    ResolvedScene,
    appearance_of,
    check_memory,
    reduced,
    resolve,
    resolved_parts,
    start_maps,
)
from facerender.drawing.resources import Resources, free, free_dropped, read
from facerender.drawing.shadows import shadow_texels
from facerender.errors import ContextError, check_switch, check_type, clipped
from facerender.loading import MeshSource, load_mesh
from facerender.mesh.hints import emit, emit_all, too_clear
from facerender.mesh.mesh import Mesh, blends_only
from facerender.scene.camera import Camera
from facerender.scene.environment import EnvironmentSource
from facerender.scene.file import ImageSettings
from facerender.scene.job import Job
from facerender.scene.landmarks import Landmarks, located
from facerender.scene.light import Light
from facerender.scene.scattering import scattering_of
from facerender.scene.scene import (
    DATA,
    ONLY,
    Only,
    Scene,
    ShadingRate,
    check_only,
    check_shading_rate,
)
from facerender.scene.shading import Shading
from facerender.scene.view import View, sample_grid, view_of
from facerender.terms import AnyLobe
from facerender.texture.mips import Kind
from facerender.values.ranges import MEMORY, ranges_of
from facerender.values.vectors import Vector

if TYPE_CHECKING:
    from facerender.drawing.lens import Lens

_LIMITS = ranges_of(ImageSettings)
_MOST_FRAMES = 8  # compiled frames of an appearance


class Renderer:
    """Renderer of scenes, which caches meshes, maps, programs and framebuffers between frames.

    Use it as a context manager, or call :meth:`release`. A renderer that is garbage-collected
    without release frees its objects and warns (ResourceWarning). Threads may share a renderer, but
    only one thread draws at a time. After a fork, the child process must create a new renderer.

    Parameters
    ----------
    size : width and height in pixels, or one number for both, each in [1, 16384]; default 1024
    samples : samples per pixel, 1 to 64, default 4. Up to the driver's limit (4 on Mesa's software
        driver), multisampling shades each visible surface once per pixel; a GPU's driver may shade
        it more often. Above this limit, the renderer averages one image per sample, so that each
        sample is shaded
    backend : "auto" (default), "egl", "osmesa", "native" for WGL, CGL or GLX, or "current" for the
        host's context
    anisotropy : maximum anisotropy of texture filtering, 1 (isotropic, default) to 16; slow on
        a software driver
    float_albedo : whether albedo maps are stored as linear float16 instead of 8-bit sRGB, so that
        images of different drivers differ only in the last digits; default false
    full_maps : whether maps of more than 4096 x 4096 texels keep their finest mip levels, even if
        the image does not need these; default false, but float_albedo implies it
    alpha_threshold : smallest opacity of a blended part that data images, such as mask and depth,
        and landmarks count as a surface, in [0, 1]; default 0.5. Parts that transmit light are
        never counted
    memory : limit of the process's memory in MiB, at least 1; a scene that needs more is refused.
        None (default) is the free memory of the system

    Raises
    ------
    InputError : a value outside its domain
    ContextError : no OpenGL context is available, or the driver does not support the size
    """

    def __init__(
        self,
        size: int | tuple[int, int] = 1024,
        *,
        samples: int = 4,
        backend: Backend = "auto",
        anisotropy: float = 1.0,
        float_albedo: bool = False,
        full_maps: bool = False,
        alpha_threshold: float = 0.5,
        memory: float | None = None,
    ) -> None:
        self.size = _LIMITS["size"].check("size", size)
        self.samples = _LIMITS["samples"].check("samples", samples)
        _LIMITS["anisotropy"].check("anisotropy", anisotropy)
        _LIMITS["alpha_threshold"].check("alpha_threshold", alpha_threshold)
        for name, value in (("float_albedo", float_albedo), ("full_maps", full_maps)):
            check_switch(name, value)
        # Depth peeling reads the target of the previous layer: other threads must not change it.
        self._layer_lock = threading.Lock()
        if memory is not None:
            MEMORY.check("memory", memory)
        self.anisotropy, self.full_maps, self.memory = anisotropy, full_maps, memory
        self.alpha_threshold = alpha_threshold
        self.albedo_kind: Kind = "linear-color" if float_albedo else "color"
        self._checked: tuple[object, int] | None = None  # appearance and samples that fit in memory
        # A renderer of another size, for undistorted images.
        self._resized: Renderer | None = None
        self.context = create_context(backend)
        self._resources = Resources(self.context, anisotropy)
        self._free = weakref.finalize(self, free_dropped, self._resources)
        self._free.atexit = False
        try:
            self._check_size()
        except ContextError:
            self.release()
            raise

    def _check_size(self) -> None:
        if max(self.size) > (limit := self.context.max_side):
            raise ContextError(
                f"size {self.size[0]} x {self.size[1]}: {self.context.renderer} allows at most "
                f"{limit} pixels a side; give a smaller size"
            )

    @classmethod
    def of(cls, job: Job, backend: Backend = "auto", memory: float | None = None) -> Renderer:
        """Return a renderer for the image settings of a job; see :class:`Renderer`."""
        check_type("job", job, Job, "a facerender.Job")
        return cls(**vars(job.image), backend=backend, memory=memory)

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.release()

    def release(self) -> None:
        """Free all GPU objects, and the context unless the host owns it.

        Further calls have no effect, nor do calls in a process forked from the renderer's process.
        """
        if self.context.closed:
            return
        free(self._resources)
        self._free.detach()

    def __repr__(self) -> str:
        width, height = self.size
        driver = clipped(self.context.renderer, 60)
        return f"<Renderer {width} x {height}, samples {self.samples}, {driver}>"

    @cached_property
    def metadata(self) -> dict[str, str]:
        """Version, driver and settings. Frames add the scene and the shading to this metadata."""
        return {
            "facerender": __version__,
            "GL_RENDERER": self.context.renderer,
            "GL_VERSION": self.context.version,
            "samples": str(self.samples),
            "anisotropy": str(self.anisotropy),
            "float_albedo": str(self.albedo_kind == "linear-color"),
        }

    def render(
        self,
        scene: Scene,
        shading: Shading = Shading(),
        only: Only | None = None,
        samples: int | None = None,
        shading_rate: ShadingRate = "sample",
    ) -> Frame:
        """Draw a scene.

        Parameters
        ----------
        only : term to draw instead of the whole image. All terms except specular and diffuse are
            data images: they have one sample per pixel, and blended parts count as surfaces where
            their opacity is at least the renderer's ``alpha_threshold``. "motion" needs
            ``scene.before``
        samples : samples per pixel; default: the renderer's samples
        shading_rate : "sample" (default) shades each triangle that covers a sample of the pixel.
            "pixel" shades each part once per pixel, at the triangle that covers most of the part's
            samples. If :meth:`can_shade_per_pixel` is false, "sample" is used. Both rates have
            the same coverage. With "pixel", edges between two surfaces of one part look as in an
            image with one sample per pixel

        Raises
        ------
        InputError : a map is damaged; m lies outside the lobe's domain and ``shading.outside`` is
            "error"; the term ``only`` is unknown; a pixel is not finite; the frame before is
            missing or has other triangles, for motion

        Warns
        -----
        FacerenderWarning : no pixel shows the mesh; the message gives the reason. The opacity of a
            part is below ``alpha_threshold`` everywhere, for data images. A hint of
            :mod:`facerender.mesh.hints`. The last two are emitted once for each mesh
        """
        _check_scene(scene, shading)
        check_shading_rate("shading_rate", shading_rate)
        check_type("only", only, str | None, f"one of {', '.join(ONLY)}")
        check_only(only)
        samples = self.samples if samples is None else _LIMITS["samples"].check("samples", samples)
        if only in DATA:
            return self._data_frame(scene, shading, only)
        if shading_rate == "pixel" and not self.can_shade_per_pixel(scene, samples, shading):
            shading_rate = "sample"
        linear, resolved = self._radiance(scene, shading, samples, only, shading_rate)
        check_image(linear, scene)
        emit_all(resolved.scene.mesh)
        settings = self.metadata | {"samples": str(samples)}
        settings |= {"shading_rate": shading_rate} if shading_rate == "pixel" else {}
        settings |= {"only": only} if only else {}
        kind, look = self.albedo_kind, resolved.appearance
        metadata = LazyMetadata(
            lambda: {
                **scene_metadata(scene, appearance_of(scene, shading, kind)),
                **shading_metadata(look, only),
                **settings,
            }
        )
        return Frame(linear, only, scene.background is None, metadata)

    def _radiance(
        self,
        scene: Scene,
        shading: Shading,
        samples: int,
        only: Only | None,
        shading_rate: ShadingRate,
    ) -> tuple[NDArray[np.float32], ResolvedScene]:
        """Return the linear image of a scene, (H, W, 4), and the resolved scene."""
        view = view_of(scene, self.size[0] / self.size[1])
        if lens := _lens(scene, self.size):
            wide, flat = self._of_size(lens.wide), lens.undistorted(scene)
            linear, resolved = wide._radiance(flat, shading, samples, only, shading_rate)
            return lens.filtered(linear), resolved
        resolved = self._resolved(scene, shading, view, samples)
        if samples <= self.context.most_samples:
            return self._shaded(resolved, view, samples, only, shading_rate), resolved
        linear = np.zeros((*self.size[::-1], 4), dtype=np.float32)
        for shift in sample_grid(samples):
            linear += self._shaded(resolved, view.shifted(shift, self.size), 1, only)
        linear /= samples
        return linear, resolved

    def _data_frame(self, scene: Scene, shading: Shading, only: Only) -> Frame:
        """Return the frame of a G-buffer term or of motion, with one sample per pixel."""
        simpler = shading if only == "visibility" else shading.replace(shadow_lights=())
        if only == "motion":
            linear = self._motion(scene, simpler)
        else:
            linear = data_view(self.gbuffer(scene, simpler, blended=False, cut=True), scene, only)
        check_image(linear, scene, self.alpha_threshold)
        metadata = self.data_metadata(scene, shading, only)
        return Frame(linear, only, scene.background is None, metadata)

    def data_metadata(self, scene: Scene, shading: Shading, only: Only) -> dict[str, str]:
        """Return the metadata of a data image."""
        look = appearance_of(scene, shading, self.albedo_kind)
        metadata = scene_metadata(scene, look) | self.metadata
        metadata |= {"samples": "1", "only": only, "alpha_threshold": str(self.alpha_threshold)}
        if only == "parts":
            metadata["parts"] = ", ".join(part.name for part in scene.mesh.parts)
        return metadata

    def _resolve(self, scene: Scene, shading: Shading) -> ResolvedScene:
        return resolve(scene, shading, self.albedo_kind)

    def _motion(self, scene: Scene, shading: Shading) -> NDArray[np.float32]:
        """Return the motion vectors of a scene; see ``Frame.linear``."""
        before, aspect = check_before(scene), self.size[0] / self.size[1]
        views = view_of(scene, aspect), view_of(before, aspect)
        lens, renderer, flat = _lens(scene, self.size), self, scene
        if lens:
            renderer, flat = self._of_size(lens.wide), lens.undistorted(scene)
        view = view_of(flat, renderer.size[0] / renderer.size[1])
        resolved = renderer._cut(renderer._resolved(flat, shading, view, 1))
        make = lambda: [triangle_pass(resolved.appearance)]  # noqa: E731
        (triangles,) = renderer._draw("triangles", resolved, None, make, view)
        triangles = lens.nearest_values(triangles) if lens else triangles
        rays = 2.0 * (lens.places if lens else pixel_centres(self.size)) / renderer.size - 1.0
        return motion_vectors(scene, before, views, resolved, triangles, view, rays)

    def landmarks(
        self, scene: Scene, landmarks: Landmarks
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return the pixels, depths and visibility of landmarks in the image of a scene.

        Returns
        -------
        pixels : (N, 2), x to the right and y down; the image's top left corner is (0, 0), its first
            pixel's centre (0.5, 0.5). NaN behind the camera
        depth : (N,), distance from the camera along the viewing direction, in mesh units
        visible : (N,), whether the landmark is in the image, with no surface in front of it; see
            :func:`facerender.scene.landmarks.located`. Blended parts hide it where their opacity
            is at least ``alpha_threshold``

        Raises
        ------
        InputError : :meth:`Landmarks.positions` or :meth:`render` raises this error
        """
        check_type("landmarks", landmarks, Landmarks, "the result of load_landmarks")
        depth = self.render(scene, only="depth").linear
        view = view_of(scene, self.size[0] / self.size[1])
        return located(view, scene.mesh, landmarks.positions(scene.mesh), depth)

    def can_shade_per_pixel(self, scene: Scene, samples: int, shading: Shading = Shading()) -> bool:
        """Return whether a frame with `samples` per pixel can have ``shading_rate="pixel"``.

        `samples` must be the driver's largest number of samples, and more than 1. The scene may
        have up to 16 million triangles. No part may have an alpha mask. Parts that are not blended
        must use one set of texture coordinates. No channel of the background may exceed 1000.
        """
        _check_scene(scene, shading)
        _LIMITS["samples"].check("samples", samples)
        look = self._resolve(scene, shading).appearance
        return samples > 1 and self._can_defer(look, scene.background, samples)

    def gbuffer(
        self, scene: Scene, shading: Shading = Shading(), blended: bool = True, cut: bool = False
    ) -> GBuffer:
        """Draw the G-buffer of a scene. For errors see :meth:`render`.

        Parameters
        ----------
        blended : whether to draw blended parts too, with one G-buffer for each of their layers;
            default true
        cut : whether blended parts that do not transmit light become surfaces where their opacity
            is at least ``alpha_threshold``, as in data images; default false
        """
        _check_scene(scene, shading)
        check_switch("blended", blended)
        check_switch("cut", cut)
        view = view_of(scene, self.size[0] / self.size[1])
        if lens := _lens(scene, self.size):
            wide, flat = self._of_size(lens.wide), lens.undistorted(scene)
            return lens.nearest(wide.gbuffer(flat, shading, blended, cut), view)
        # The G-buffer needs the memory of an image with four samples.
        original = self._resolved(scene, shading, view, 4)
        resolved = self._cut(original) if cut else original
        with self._layer_lock:
            layers = [
                layer
                for part in (_far_first(resolved, view) if blended else ())
                for layer in self._layers(resolved, view, part)
            ]
        gbuffer, _ = self._gbuffer(resolved, view, casting=original)
        return replace(gbuffer, transparent_layers=tuple(layers))

    def _cut(self, resolved: ResolvedScene) -> ResolvedScene:
        """Return the scene of data images: blended parts that do not transmit light become parts
        with an alpha mask, which have a surface where their opacity is at least alpha_threshold.
        Many exporters mark a whole face as blended."""
        mesh = resolved.scene.mesh
        emit(mesh, too_clear, too_clear(mesh, self.alpha_threshold))
        if not any(map(blends_only, mesh.materials)):
            return resolved
        mask: dict[str, Any] = {"alpha": "mask", "alpha_cutoff": self.alpha_threshold}
        new = (replace(old, **mask) if blends_only(old) else old for old in mesh.materials)
        cut = replace(resolved.scene, mesh=replace(mesh, materials=tuple(new)))
        return self._resolve(cut, resolved.appearance.shading)

    def _layers(self, resolved: ResolvedScene, view: View, part: int) -> list[GBuffer]:
        """Return all layers of a blended part by depth peeling, in drawing order at each pixel."""
        layers: list[GBuffer] = []
        numbers: list[NDArray[np.float32]] = []
        while True:
            layer, number = self._gbuffer(resolved, view, Layer(part, len(layers)))
            if not (layer.part >= 0).any():
                return in_order(layers, np.array(numbers))
            layers.append(layer)
            numbers.append(number)

    def _gbuffer(
        self,
        resolved: ResolvedScene,
        view: View,
        layer: Layer | None = None,
        casting: ResolvedScene | None = None,
    ) -> tuple[GBuffer, NDArray[np.float32]]:
        """Return the G-buffer of all parts that are not blended, or of one layer of a blended part;
        and for a layer, the index of each pixel's triangle in drawing order, otherwise no values.

        casting : scene whose parts cast the shadows; default: the resolved scene
        """
        scene, look = resolved.scene, resolved.appearance
        of = self._structure(resolved, view, 1, scatters=layer is None)
        of = replace(of, defers=lambda samples: False) if layer else of
        inputs: dict[str, moderngl.Texture] = {}
        names = surface_images(scene, layer is not None)
        if layer and layer.index:
            previous = Target(len(names), sampled=True, number=1 - layer.index % 2)
            framebuffer = self._resources.targets[sized(previous, self.size)].framebuffer
            inputs["previous_layer"] = framebuffer.color_attachments[-1]  # type: ignore[assignment]
        make = partial(surface_passes, of, names, layer)
        surfaces = self._draw("surface", resolved, (of.key, layer), make, view, inputs)
        images = dict(zip(names, surfaces, strict=True))
        position, normal, albedo, uv = (images[name] for name in names[:4])
        lobes, emitted, order = (images.get(name) for name in ("lobes", "emitted", "layer"))
        visibilities = np.ones((*position.shape[:2], len(scene.lights)), dtype=np.float32)
        if number := len(look.lighting.shadowed):
            cast = (casting or resolved).appearance
            make, key = partial(fraction_passes, of, layer, cast), (of.key, layer, cast.token)
            fractions = self._draw("fractions", resolved, key, make, view, inputs)
            all_fractions = np.concatenate(fractions, axis=-1)[..., :number]
            visibilities[..., look.lighting.shadowed] = all_fractions
        material = scene.mesh.materials[layer.part] if layer else None
        gbuffer = GBuffer(
            part=position[..., 3].astype(np.int64) - 1,
            normalised_position=position[..., :3],
            normal=normal[..., :3],
            albedo=albedo[..., :3],
            m=normal[..., 3],
            specular_weight=albedo[..., 3],
            occlusion=uv[..., 2],
            uv=uv[..., :2],
            visibility=visibilities,
            view=view,
            space=(*scene.mesh.center.tolist(), scene.mesh.radius),
            second_m=None if lobes is None else lobes[..., 0],
            lobe_weight=None if lobes is None else lobes[..., 1],
            facing=uv[..., 3] if of.scattering else None,
            emission=None if emitted is None else emitted[..., :3],
            opacity=uv[..., 3] if layer else None,
            transmission=material.transmission if material and material.thin else 0.0,
        )
        return gbuffer, np.empty((0, 0), np.float32) if order is None else order[..., 1]

    def _resolved(self, scene: Scene, shading: Shading, view: View, samples: int) -> ResolvedScene:
        """Simplify and resolve a scene, check the memory it needs, and start to decode its maps."""
        resolved = self._resolve(scene, shading)
        if not (self.full_maps or self.albedo_kind == "linear-color"):
            smaller = reduced(resolved, view, self.size, self.anisotropy)
            if smaller is not resolved.scene:
                resolved = self._resolve(smaller, shading)
        at_once, look = min(samples, self.context.most_samples), resolved.appearance
        if self._checked != (look.token, at_once):
            check_memory(resolved, self.size, at_once, self.memory)
            self._checked = look.token, at_once
            self._resources.take_coarse(look.parts)
            start_maps(look.parts)
        return resolved

    def _shaded(
        self,
        resolved: ResolvedScene,
        view: View,
        samples: int,
        only: Only | None = None,
        shading_rate: ShadingRate = "sample",
    ) -> NDArray[np.float32]:
        """Draw an image of a view; `samples` must not exceed the driver's limit."""
        shows = only is None, only != "specular"
        of = self._structure(resolved, view, samples, *shows, shading_rate)
        make = partial(image_passes, of, only)
        return self._draw(f"image {only}", resolved, of.key, make, view)[0]

    def _structure(
        self,
        resolved: ResolvedScene,
        view: View,
        samples: int,
        refracts: bool = True,
        scatters: bool = True,
        rate: ShadingRate = "sample",
    ) -> Structure:
        """Return what the passes of a frame depend on, for :func:`image_passes` and others."""
        scene, look, mesh = resolved.scene, resolved.appearance, resolved.scene.mesh
        background = scene.background or (0.0, 0.0, 0.0)
        refraction = None
        if refracts and look.refracts:
            from facerender.drawing.refraction import Refraction  # only if a scene needs it

            refraction = Refraction(look, mesh, view, self.size, background)
        defers = partial(self._defers, look, background, rate)
        texels = shadow_texels(look, view, self.size)
        scattering = scattering_of(scene, view, self.size) if scatters and look.scatters else None
        return Structure(
            look, mesh, background, samples, defers, rate, texels, refraction, scattering
        )

    def _defers(
        self, look: Appearance, background: Vector, rate: ShadingRate, samples: int
    ) -> bool:
        """Return whether to draw only visible triangles: if asked for the rate "pixel", and where
        it is cheaper."""
        driver, parts = self.context.renderer, [part.part for part in look.parts]
        return self._can_defer(look, background, samples) and (
            rate == "pixel" or deferred_is_cheaper(parts, self.size, samples, driver)
        )

    def _can_defer(self, look: Appearance, background: Vector | None, samples: int) -> bool:
        """Return whether driver and scene support deferred shading. With other numbers of samples
        than 1 or its maximum, a driver may use more than requested without reporting how many."""
        rows = self.context.gl.info["GL_MAX_TEXTURE_SIZE"]
        return samples in (1, self.context.most_samples) and can_defer(look, background, rows)

    def _of_size(self, size: tuple[int, int]) -> Renderer:
        """Return a renderer of another size with the same context, geometry, maps and programs. The
        last one is cached; targets of earlier sizes are freed."""
        resized = self._resized
        if resized is None or resized.size != size:
            resized = copy(self)
            resized.size, resized._resized = size, None
            resized._checked = None
            resized._check_size()
            with self._layer_lock, self.context.drawing() as gl:
                resources = self._resources
                old = [t for t in resources.targets if resized and t.size == resized.size]
                for target in old:
                    del resources.targets[target]
                resources.frames.clear()
                gl.gc()
            self._resized = resized
        return resized

    # --- OpenGL ----------------------------------------------------------------------------------

    def _draw(
        self,
        name: str,
        resolved: ResolvedScene,
        key: Hashable,
        make: Callable[[], list[Pass]],
        view: View,
        inputs: Mapping[str, moderngl.Texture] = {},
    ) -> list[NDArray[np.float32]]:
        """Draw a frame, which is compiled on first use, and return the images of its last pass.

        name, key : value that is equal for frames of one appearance and size with equal passes
        make : returns these passes
        inputs : further textures that passes read, by uniform name. Such a frame is not cached
        """
        scene = resolved.scene
        panorama = scene.environment.panorama if scene.environment else None
        with self.context.drawing():
            self._resources.settle()
            frames = self._resources.frames.setdefault(resolved.appearance, {})
            address = self.size, name, key
            frame = None if inputs else frames.pop(address, None)
            if frame is None:
                frame = CompiledFrame(self._resources, make(), self.size, panorama, inputs)
            if not inputs:
                frames[address] = frame
                if len(frames) > _MOST_FRAMES:
                    del frames[next(iter(frames))]
            target = frame.draw(view, scene.mesh)
            return [read(target, index) for index in range(len(target.color_attachments))]


def _far_first(resolved: ResolvedScene, view: View) -> list[int]:
    """Return the indices of the blended parts in drawing order. The part whose nearest vertex has
    the largest depth comes first."""
    setups = resolved.scene.mesh.setups
    parts = [part.index for part in resolved.appearance.blended]
    return sorted(parts, key=lambda i: -float((setups[i].positions @ view.forward).min()))


def _lens(scene: Scene, size: tuple[int, int]) -> Lens | None:
    """Return the lens of a scene's camera, or None without distortion."""
    if scene.camera.distortion is None:
        return None
    from facerender.drawing.lens import lens_of

    return lens_of(scene.camera, size)


def _check_scene(scene: Scene, shading: Shading = Shading()) -> None:
    check_type("scene", scene, Scene, "a facerender.Scene")
    check_type("shading", shading, Shading, "a facerender.Shading")


def render(
    mesh: Mesh | MeshSource | None = None,
    *,
    model: str = "cook-torrance",
    lobe: AnyLobe = "exact",
    fresnel: str = "schlick",
    masking: str = "v-cavity",
    outside: str = "error",
    m: float | None = None,
    size: int | tuple[int, int] = 1024,
    samples: int = 4,
    backend: Backend = "auto",
    camera: Camera | str = Camera(),
    lights: Sequence[Light | str] | None = None,
    ambient: float | Vector | None = None,
    background: Vector | str | None = Scene.background,
    environment: EnvironmentSource | None = None,
    only: Only | None = None,
) -> Frame:
    """Render one image of a mesh.

    For several images or other settings, use a :class:`Renderer`, which caches uploaded meshes and
    maps.

    Parameters
    ----------
    mesh : a mesh, a source that :func:`facerender.load_mesh` accepts, or None for the built-in head
    model, lobe, fresnel, masking, outside : see :class:`Shading`
    m : RMS slope of the microfacets of the skin (:attr:`Mesh.skin`), which replaces the roughness
        map; default: the values of the mesh
    size, samples, backend : see :class:`Renderer`
    camera, lights, ambient, background, environment : see :class:`Scene`
    only : see :meth:`Renderer.render`

    Raises
    ------
    InputError : a file or a value cannot be used
    ContextError : no OpenGL context is available
    """
    shading = Shading(model, lobe, fresnel, masking=masking, outside=outside)
    loaded = mesh if isinstance(mesh, Mesh) else load_mesh(mesh)
    if m is not None:
        loaded = loaded.with_skin(m=m)
    start_maps(resolved_parts(loaded))
    scene = Scene(loaded, camera, lights, ambient, background, environment)
    with Renderer(size, samples=samples, backend=backend) as renderer:
        return renderer.render(scene, shading, only)
