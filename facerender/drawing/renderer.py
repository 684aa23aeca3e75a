"""The renderer, which draws the passes of a scene and reads the image back as float32."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender import __version__
from facerender.drawing.context import Backend, create_context
from facerender.drawing.frame import (
    Frame,
    GBuffer,
    check_image,
    data_view,
    in_order,
    mesh_metadata,
    scene_metadata,
    shading_metadata,
)
from facerender.drawing.motion import check_before, motion_vectors, pixel_centres, triangle_pass
from facerender.drawing.passes import (
    BlendedPart,
    Pass,
    Target,
    Visibility,
    blended_area,
    blended_parts,
    can_defer,
    deferred,
    deferred_is_cheaper,
    with_blended,
)
from facerender.drawing.prepare import (
    ResolvedScene,
    appearance_of,
    check_memory,
    reduced,
    resolve,
    resolved_parts,
    start_maps,
)
from facerender.drawing.program import ENVIRONMENT_MAP
from facerender.drawing.resources import Resources, free, free_dropped, read
from facerender.drawing.shade import (
    light_visibility_pass,
    scatter_pass,
    shade_pass,
    surface_images,
    surface_pass,
    with_shadows,
)
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
    from facerender.drawing.refraction import Refraction

_LIMITS = ranges_of(ImageSettings)


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
        # A renderer of another size, for undistorted images, and the other sizes with targets.
        self._resized: Renderer | None = None
        self._sizes: set[tuple[int, int]] = set()
        self.context = create_context(backend)
        self._resources = Resources(self.context, self.size, anisotropy)
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
        if self.context.released or self.context.inherited:
            return
        free(self._resources)
        self._free.detach()

    def __repr__(self) -> str:
        width, height = self.size
        driver = clipped(self.context.renderer, 60)
        return f"<Renderer {width} x {height}, samples {self.samples}, {driver}>"

    @property
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
        samples = self.samples if samples is None else samples
        check_only(only)
        if only in DATA:
            return self._data_frame(scene, shading, only)
        _LIMITS["samples"].check("samples", samples)
        if shading_rate == "pixel" and not self.can_shade_per_pixel(scene, samples, shading):
            shading_rate = "sample"
        linear, resolved = self._radiance(scene, shading, samples, only, shading_rate)
        check_image(linear, scene)
        emit_all(resolved.scene.mesh)
        metadata = self._metadata(scene, shading) | shading_metadata(resolved, only)
        metadata |= self.metadata | {"samples": str(samples)}
        metadata |= {"shading_rate": shading_rate} if shading_rate == "pixel" else {}
        metadata |= {"only": only} if only else {}
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
        metadata = self._metadata(scene, shading) | self.metadata
        metadata |= {"samples": "1", "only": only, "alpha_threshold": str(self.alpha_threshold)}
        if only == "parts":
            metadata["parts"] = ", ".join(part.name for part in scene.mesh.parts)
        return metadata

    def _metadata(self, scene: Scene, shading: Shading) -> dict[str, str]:
        """Return the scene as text. Most frames have the mesh of the frame before."""
        mesh, look = scene.mesh, appearance_of(scene, shading, self.albedo_kind)
        texts: dict[str, str] = look.draws.of("mesh", mesh.token, lambda: mesh_metadata(mesh))
        return texts | scene_metadata(scene, look.parts)

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
        render_pass = triangle_pass(resolved, view)
        (triangles,) = renderer._draw([render_pass], resolved.scene)
        triangles = lens.nearest_values(triangles) if lens else triangles
        rays = 2.0 * (lens.places if lens else pixel_centres(self.size)) / renderer.size - 1.0
        return motion_vectors(scene, before, views, render_pass.draws, triangles, view, rays)

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
        return samples > 1 and self._can_defer(self._resolve(scene, shading), samples)

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
                for blended_part in (blended_parts(resolved, view) if blended else ())
                for layer in self._layers(resolved, view, blended_part)
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

    def _layers(
        self, resolved: ResolvedScene, view: View, blended_part: BlendedPart
    ) -> list[GBuffer]:
        """Return all layers of a blended part by depth peeling, in drawing order at each pixel."""
        layers: list[GBuffer] = []
        numbers: list[NDArray[np.float32]] = []
        while True:
            part = replace(blended_part, layer=len(layers))
            layer, number = self._gbuffer(resolved, view, part)
            if not (layer.part >= 0).any():
                return in_order(layers, np.array(numbers))
            layers.append(layer)
            numbers.append(number)

    def _gbuffer(
        self,
        resolved: ResolvedScene,
        view: View,
        blended_part: BlendedPart | None = None,
        casting: ResolvedScene | None = None,
    ) -> tuple[GBuffer, NDArray[np.float32]]:
        """Return the G-buffer of all parts that are not blended, or of one layer of a blended part;
        and for a layer, the index of each pixel's triangle in drawing order, otherwise no values.

        casting : scene whose parts cast the shadows; default: the resolved scene
        """
        scene, lighting = resolved.scene, resolved.appearance.lighting
        visibility = None if blended_part else self._visibility(resolved, view, 1)
        scatters = not blended_part and scattering_of(scene, self.size) is not None
        refraction = _refraction(resolved, view, self.size)
        surface = surface_pass(resolved, view, scatters, blended_part, refraction)
        passes = deferred(visibility, surface)
        if refraction:
            passes = [*refraction.passes(resolved), *passes]
            passes = with_shadows(resolved, view, self.size, passes)
        textures: dict[str, moderngl.Texture] = {}
        if blended_part and blended_part.layer:
            prior_target = self._sized(replace(surface.target, number=1 - surface.target.number))
            attachments = self._resources.targets[prior_target].color_attachments
            textures["previous_layer"] = attachments[-1]  # type: ignore[assignment]
        names = surface_images(scene, blended_part is not None)
        images = dict(zip(names, self._draw(passes, scene, textures), strict=True))
        position, normal, albedo, uv = (images[name] for name in names[:4])
        lobes, emitted, order = (images.get(name) for name in ("lobes", "emitted", "layer"))
        visibilities = np.ones((*position.shape[:2], len(scene.lights)), dtype=np.float32)
        if number := len(lighting.shadowed):
            passes = deferred(visibility, light_visibility_pass(resolved, view, blended_part))
            passes = with_shadows(casting or resolved, view, self.size, passes)
            fractions = self._draw(passes, scene, textures)
            visibilities[..., lighting.shadowed] = np.concatenate(fractions, axis=-1)[..., :number]
        material = scene.mesh.materials[blended_part.part] if blended_part else None
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
            facing=uv[..., 3] if scatters else None,
            emission=None if emitted is None else emitted[..., :3],
            opacity=uv[..., 3] if blended_part else None,
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
        scene = resolved.scene
        visibility = self._visibility(resolved, view, samples, shading_rate)
        scattering = None if only == "specular" else scattering_of(scene, self.size)
        refraction = None if only else _refraction(resolved, view, self.size)
        # One sample: the shading pass also draws the inputs of scattering. Several samples may show
        # different points: another pass draws the inputs at the pixels' centres.
        inputs = scattering if samples == 1 else None
        forward = shade_pass(resolved, view, samples, only, inputs, refraction=refraction)
        passes = deferred(visibility, forward)
        if scattering:
            background = scene.background if inputs and only is None else None
            mesh_area = visibility.area if inputs and visibility else None
            if not inputs:
                image = passes.pop()
                draws = tuple(draw for draw in image.draws if draw.depth != "blend")
                target = replace(image.target, sampled=True)
                passes.append(replace(image, name="image", target=target, draws=draws))
                light = shade_pass(resolved, view, 1, "diffuse", scattering, apart=True)
                passes += deferred(self._visibility(resolved, view, 1), light)
            count = resolved.appearance.shading.scatter_samples
            passes.append(scatter_pass(view, scattering, count, background, samples > 1, mesh_area))
        blended = blended_area(resolved, view, self.size)
        if (scattering or visibility) and not blended.empty:
            if inputs:
                forward = shade_pass(resolved, view, samples, only, refraction=refraction)
            visible = visibility.target if visibility else None
            passes += with_blended(forward, passes.pop(), blended, visible)
        if refraction:
            passes = [*refraction.passes(resolved), *passes]
        return self._draw(with_shadows(resolved, view, self.size, passes), scene)[0]

    def _visibility(
        self, resolved: ResolvedScene, view: View, samples: int, rate: ShadingRate = "sample"
    ) -> Visibility | None:
        """Return the visible triangles for deferred shading, which draws per pixel and where it is
        cheaper, or None for forward shading."""
        driver = self.context.renderer
        if self._can_defer(resolved, samples) and (
            rate == "pixel" or deferred_is_cheaper(resolved.scene, self.size, samples, driver)
        ):
            return Visibility.of(resolved, view, self.size, samples, rate)
        return None

    def _can_defer(self, resolved: ResolvedScene, samples: int) -> bool:
        """Return whether driver and scene support deferred shading. With other numbers of samples
        than 1 or its maximum, a driver may use more than requested without reporting how many."""
        rows = self.context.gl.info["GL_MAX_TEXTURE_SIZE"]
        return samples in (1, self.context.most_samples) and can_defer(resolved, rows)

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
                for target in [key for key in resources.targets if key.size in self._sizes]:
                    for cache in (resources.targets, resources.scopes, resources.images_held):
                        cache.pop(target, None)
                gl.gc()
                self._sizes.clear()
            self._resized = resized
        return resized

    def _sized(self, target: Target) -> Target:
        """Return a target with an explicit size, unless it has the size of the resources."""
        if self.size == self._resources.size:
            return target
        self._sizes.add(self.size)
        below = target.depth_of and self._sized(target.depth_of)
        return replace(target, size=target.size or self.size, depth_of=below)

    # --- OpenGL ----------------------------------------------------------------------------------

    def _draw(
        self, passes: list[Pass], scene: Scene, inputs: Mapping[str, moderngl.Texture] = {}
    ) -> list[NDArray[np.float32]]:
        """Draw passes in order, and return the images of the last pass. They may read ``inputs``,
        further textures by uniform name."""
        textures = dict(inputs)
        with self.context.drawing() as gl:
            self._resources.settle()
            if scene.environment is not None:
                textures[ENVIRONMENT_MAP] = self._resources.panorama(scene.environment.panorama)
            for step in passes:
                if (sized := self._sized(step.target)) is not step.target:
                    step = replace(step, target=sized)
                target = self._resources.draw(step, scene.mesh, textures)
                if sized.samples > 1 and sized.values == "color" and sized.resolved:
                    single = self._resources.target(replace(sized, samples=1))
                    gl.copy_framebuffer(single, target)
                    target = single
                if sized.sampled:
                    names = (step.name, *step.others)
                    textures |= zip(names, target.color_attachments, strict=False)  # type: ignore[arg-type]
            return [read(target, index) for index in range(sized.colors)]


# The next two functions import their modules only if a scene needs them.


def _refraction(resolved: ResolvedScene, view: View, size: tuple[int, int]) -> Refraction | None:
    """Return the refraction of a scene, or None."""
    if not any(material.refracts for material in resolved.appearance.materials):
        return None
    from facerender.drawing.refraction import Refraction

    return Refraction.of(resolved, view, size)


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
