"""The renderer, which draws the passes of a scene and reads the image back as float32."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender import __version__
from facerender.drawing.compiled import CompiledFrame, sized
from facerender.drawing.context import Backend, create_context
from facerender.drawing.data_passes import (
    PLANES,
    Layer,
    fraction_passes,
    plane_passes,
    surface_images,
    surface_passes,
    triangle_pass,
)
from facerender.drawing.frame import (
    PLANES_OF,
    Frame,
    GBuffer,
    LazyMetadata,
    check_images,
    data_image,
    in_order,
    scene_metadata,
    shading_metadata,
)
from facerender.drawing.frame_passes import (
    Structure,
    can_defer,
    deferred_is_cheaper,
    image_passes,
)
from facerender.drawing.motion import check_before, motion_vectors, pixel_centres
from facerender.drawing.passes import Pass, Target
from facerender.drawing.prepare import (
    Appearance,
    ResolvedPart,
    ResolvedScene,
    appearance_of,
    check_memory,
    reduced,
    resolve,
    resolved_parts,
    start_maps,
)
from facerender.drawing.resources import Resources, free, free_dropped
from facerender.drawing.shadows import shadow_texels
from facerender.errors import (
    ContextError,
    check_known,
    check_switch,
    check_type,
    clipped,
    each_of,
)
from facerender.loading import MeshSource, load_mesh
from facerender.mesh.hints import emit, emit_all, too_clear
from facerender.mesh.mesh import Mesh, blends_only, drawn_alpha
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
_DATA_SAMPLES = 4  # the planes of all data images need the memory of an image with four samples


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
        # Appearances, and their samples at once, that fit in memory.
        self._checked: WeakKeyDictionary[Appearance, int] = WeakKeyDictionary()
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
        check_type("only", only, str | None, f"one of {', '.join(ONLY)}")
        check_only(only)
        name = only or "image"
        return self.render_outputs(scene, (name,), shading, samples, shading_rate)[name]

    def render_outputs(
        self,
        scene: Scene,
        outputs: Iterable[str],
        shading: Shading = Shading(),
        samples: int | None = None,
        shading_rate: ShadingRate = "sample",
    ) -> dict[str, Frame]:
        """Draw several outputs of a scene together; a call of :meth:`render` for each would cost
        more, and draw the same.

        Parameters
        ----------
        outputs : "image" for the whole image, and terms; see :meth:`render` for the terms, the
            other parameters, errors and warnings

        Returns
        -------
        frames by output, in the order of the outputs
        """
        _check_scene(scene, shading)
        check_shading_rate("shading_rate", shading_rate)
        several = (outputs,) if isinstance(outputs, str) else outputs
        names = each_of("outputs", several, str, f"some of image, {', '.join(ONLY)}")
        for name in names:
            check_known("output", name, ("image", *ONLY))
        samples = self.samples if samples is None else _LIMITS["samples"].check("samples", samples)
        if shading_rate == "pixel" and not self.can_shade_per_pixel(scene, samples, shading):
            shading_rate = "sample"
        images, shaded = self._images(scene, shading, names, samples, shading_rate)
        if "motion" in names:
            images["motion"] = self._motion(scene, shading.replace(shadow_lights=()))
        check_images(images, scene, self.alpha_threshold)
        if shaded:
            emit_all(shaded.scene.mesh)
        still = replace(scene, before=None) if scene.before else scene
        rate = {"shading_rate": shading_rate} if shading_rate == "pixel" else {}
        frames = {}
        for name in names:
            only: Any = None if name == "image" else name
            settings = {"samples": str(samples)} | rate | ({"only": name} if only else {})
            if name in DATA:
                threshold = str(self.alpha_threshold)
                settings = {"samples": "1", "only": name, "alpha_threshold": threshold}
            arguments = scene if name == "motion" else still, shading, only, self.albedo_kind
            metadata = LazyMetadata(
                partial(_metadata, *arguments, shaded, self.metadata | settings)
            )
            frames[name] = Frame(images[name], only, scene.background is None, metadata)
        return frames

    def _images(
        self,
        scene: Scene,
        shading: Shading,
        outputs: Sequence[str],
        samples: int,
        rate: ShadingRate,
    ) -> tuple[dict[str, NDArray[np.float32]], ResolvedScene | None]:
        """Return the linear images (H, W, 4) of outputs except motion, by name; and the resolved
        scene of shaded images, None without such an image. See :meth:`render_outputs`."""
        view, images, resolved = view_of(scene, self.size[0] / self.size[1]), {}, None
        if lens := _lens(scene, self.size):
            wide, flat = self._of_size(lens.wide), lens.undistorted(scene)
            flat_images, resolved = wide._images(flat, shading, outputs, samples, rate)
            for name, image in flat_images.items():
                images[name] = (lens.nearest_values if name in DATA else lens.filtered)(image)
            return images, resolved
        data: list[Any] = [name for name in DATA if name in outputs and name != "motion"]
        names = tuple(name for name in PLANES if any(name in PLANES_OF[only] for only in data))
        planes: dict[str, NDArray[np.float32]] = {}
        for name in outputs:
            if name in DATA:
                continue
            only: Any = None if name == "image" else name
            resolved = self._resolved(scene, shading, view, samples)
            of = self._structure(resolved, view, samples, only is None, only != "specular", rate)
            together = () if planes or samples > self.context.most_samples else names
            images[name], *arrays = self._radiance(of, resolved, view, only, together)
            planes |= zip(names, arrays, strict=False)
        if names and not planes:
            unlit, of = self._for_data(scene, shading.replace(shadow_lights=()), view)
            make = partial(plane_passes, of, names, image=False)
            arrays = self._draw("data", unlit, (of.key, names), make, view)
            planes = dict(zip(names, arrays, strict=True))
        if "visibility" in data:
            first = next((i for i, light in enumerate(scene.lights) if light.shadow), None)
            resolved_data, of = self._for_data(scene, shading, view)
            if first in (shadowed := of.look.lighting.shadowed):
                fractions = self._fractions(of, resolved_data, view)
                planes["fraction"] = fractions[..., shadowed.index(first)]
        for name in data:
            images[name] = data_image(name, planes, view, scene)
        return images, resolved

    def _for_data(
        self, scene: Scene, shading: Shading, view: View
    ) -> tuple[ResolvedScene, Structure]:
        """Return a resolved scene, and the structure of frames of its data."""
        resolved = self._resolved(scene, shading, view, _DATA_SAMPLES)
        of = self._structure(resolved, view, 1, refracts=False, scatters=False)
        return resolved, self._with_cut(of)

    def _with_cut(self, of: Structure) -> Structure:
        """Return a structure with the parts that only data images show: blended parts that do not
        transmit light get an alpha mask, and have a surface where their opacity is at least
        alpha_threshold. Many exporters mark a whole face as blended."""
        emit(of.mesh, too_clear, too_clear(of.mesh, self.alpha_threshold))
        cut = []
        for part in of.look.blended:
            if blends_only(part.material):
                mask = replace(part.material, alpha="mask", alpha_cutoff=self.alpha_threshold)
                cut.append(replace(part, material=mask, alpha=drawn_alpha(part.part, mask)))
        if not cut:
            return of
        defers = self._defers([*of.look.unblended, *cut], of.look, of.background, "sample", 1)
        return replace(of, cut=tuple(cut), defers_data=defers)

    def _radiance(
        self,
        of: Structure,
        resolved: ResolvedScene,
        view: View,
        only: Only | None,
        names: tuple[str, ...] = (),
    ) -> list[NDArray[np.float32]]:
        """Draw an image of a view. Return it, (H, W, 4), and planes of data images.

        names : of the planes; () for more samples than the driver's limit
        """
        if of.samples <= self.context.most_samples:

            def make() -> list[Pass]:
                planes = plane_passes(of, names, image=True) if names else []
                return [*image_passes(of, only), *planes]

            of = self._with_cut(of) if names else of
            return self._draw(f"image {only}", resolved, (of.key, names), make, view)
        linear = np.zeros((*self.size[::-1], 4), dtype=np.float32)
        for shift in sample_grid(of.samples):
            shifted = view.shifted(shift, self.size)
            one = self._structure(resolved, shifted, 1, only is None, only != "specular")
            linear += self._radiance(one, resolved, shifted, only)[0]
        linear /= of.samples
        return [linear]

    def _motion(self, scene: Scene, shading: Shading) -> NDArray[np.float32]:
        """Return the motion vectors of a scene; see ``Frame.linear``."""
        before, aspect = check_before(scene), self.size[0] / self.size[1]
        views = view_of(scene, aspect), view_of(before, aspect)
        lens, renderer, flat = _lens(scene, self.size), self, scene
        if lens:
            renderer, flat = self._of_size(lens.wide), lens.undistorted(scene)
        view = view_of(flat, renderer.size[0] / renderer.size[1])
        resolved, of = renderer._for_data(flat, shading, view)
        parts = sorted((*of.look.unblended, *of.cut), key=lambda part: part.index)
        make = lambda: [triangle_pass(parts, shading)]  # noqa: E731
        (triangles,) = renderer._draw("triangles", resolved, None, make, view)
        triangles = lens.nearest_values(triangles) if lens else triangles
        rays = 2.0 * (lens.places if lens else pixel_centres(self.size)) / renderer.size - 1.0
        return motion_vectors(scene, before, views, parts, triangles, view, rays)

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
        look = resolve(scene, shading, self.albedo_kind).appearance
        return samples > 1 and self._can_defer(look.unblended, scene.background, samples)

    def gbuffer(self, scene: Scene, shading: Shading = Shading(), blended: bool = True) -> GBuffer:
        """Draw the G-buffer of a scene. For errors see :meth:`render`.

        Parameters
        ----------
        blended : whether to draw blended parts too, with one G-buffer for each of their layers;
            default true
        """
        _check_scene(scene, shading)
        check_switch("blended", blended)
        view = view_of(scene, self.size[0] / self.size[1])
        if lens := _lens(scene, self.size):
            wide, flat = self._of_size(lens.wide), lens.undistorted(scene)
            return lens.nearest(wide.gbuffer(flat, shading, blended), view)
        resolved = self._resolved(scene, shading, view, _DATA_SAMPLES)
        with self._layer_lock:
            layers = [
                layer
                for part in (_far_first(resolved, view) if blended else ())
                for layer in self._layers(resolved, view, part)
            ]
        gbuffer, _ = self._gbuffer(resolved, view)
        return replace(gbuffer, transparent_layers=tuple(layers))

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
        self, resolved: ResolvedScene, view: View, layer: Layer | None = None
    ) -> tuple[GBuffer, NDArray[np.float32]]:
        """Return the G-buffer of all parts that are not blended, or of one layer of a blended part;
        and for a layer, the index of each pixel's triangle in drawing order, otherwise no values.
        """
        scene, look = resolved.scene, resolved.appearance
        of = self._structure(resolved, view, 1, scatters=layer is None)
        inputs: dict[str, moderngl.Texture] = {}
        names = surface_images(scene, layer is not None)
        if layer and layer.index:
            number = 1 - layer.index % 2
            previous = Target((4,) * len(names), sampled=True, number=number)
            framebuffer = self._resources.targets[sized(previous, self.size)].framebuffer
            inputs["previous_layer"] = framebuffer.color_attachments[-1]  # type: ignore[assignment]
        make = partial(surface_passes, of, names, layer)
        surfaces = self._draw("surface", resolved, (of.key, layer), make, view, inputs)
        images = dict(zip(names, surfaces, strict=True))
        position, normal, albedo, uv = (images[name] for name in names[:4])
        lobes, emitted, order = (images.get(name) for name in ("lobes", "emitted", "layer"))
        visibilities = np.ones((*position.shape[:2], len(scene.lights)), dtype=np.float32)
        if shadowed := look.lighting.shadowed:
            visibilities[..., shadowed] = self._fractions(of, resolved, view, layer, inputs)
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

    def _fractions(
        self,
        of: Structure,
        resolved: ResolvedScene,
        view: View,
        layer: Layer | None = None,
        inputs: Mapping[str, moderngl.Texture] = {},
    ) -> NDArray[np.float32]:
        """Return the visible fractions (H, W, lights) of all lights that cast shadows, in the order
        of ``Lighting.shadowed``."""
        make, key = partial(fraction_passes, of, layer), (of.key, layer, len(of.cut))
        fractions = self._draw("fractions", resolved, key, make, view, inputs)
        return np.concatenate(fractions, axis=-1)[..., : len(of.look.lighting.shadowed)]

    def _resolved(self, scene: Scene, shading: Shading, view: View, samples: int) -> ResolvedScene:
        """Simplify and resolve a scene, check the memory it needs, and start to decode its maps."""
        resolved = resolve(scene, shading, self.albedo_kind)
        if not (self.full_maps or self.albedo_kind == "linear-color"):
            smaller = reduced(resolved, view, self.size, self.anisotropy)
            if smaller is not resolved.scene:
                resolved = resolve(smaller, shading, self.albedo_kind)
        at_once, look = min(samples, self.context.most_samples), resolved.appearance
        if self._checked.get(look, 0) < at_once:
            check_memory(resolved, self.size, at_once, self.memory)
            self._checked[look] = at_once
            self._resources.take_coarse(look.parts)
            start_maps(look.parts)
        return resolved

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
        defers = partial(self._defers, look.unblended, look, background, rate)
        texels = shadow_texels(look, view, self.size)
        scattering = scattering_of(scene, view, self.size) if scatters and look.scatters else None
        defers_data = self._defers(look.unblended, look, background, "sample", 1)
        return Structure(
            look, mesh, background, samples, defers, rate, texels, refraction, scattering,
            defers_data=defers_data,
        )  # fmt: skip

    def _defers(
        self,
        parts: Sequence[ResolvedPart],
        look: Appearance,
        background: Vector,
        rate: ShadingRate,
        samples: int,
    ) -> bool:
        """Return whether to draw only visible triangles: if asked for the rate "pixel", and where
        it is cheaper.

        parts : that are not blended
        """
        driver, all_parts = self.context.renderer, [part.part for part in look.parts]
        return self._can_defer(parts, background, samples) and (
            rate == "pixel" or deferred_is_cheaper(all_parts, self.size, samples, driver)
        )

    def _can_defer(
        self, parts: Sequence[ResolvedPart], background: Vector | None, samples: int
    ) -> bool:
        """Return whether driver and scene support deferred shading. With other numbers of samples
        than 1 or its maximum, a driver may use more than requested without reporting how many."""
        rows = self.context.gl.info["GL_MAX_TEXTURE_SIZE"]
        return samples in (1, self.context.most_samples) and can_defer(parts, background, rows)

    def _of_size(self, size: tuple[int, int]) -> Renderer:
        """Return a renderer of another size with the same context, geometry, maps and programs. The
        last one is cached; targets of earlier sizes are freed."""
        resized = self._resized
        if resized is None or resized.size != size:
            resized = copy(self)
            resized.size, resized._resized = size, None
            resized._checked = WeakKeyDictionary()
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
        """Draw a frame, which is compiled on first use, and return its results.

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
            return frame.draw(view, scene.mesh)


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


def _metadata(
    scene: Scene,
    shading: Shading,
    only: Only | None,
    albedo: Kind,
    shaded: ResolvedScene | None,
    settings: dict[str, str],
) -> dict[str, str]:
    """Return the metadata of a frame. It keeps no renderer alive.

    shaded : resolved scene of shaded images
    """
    metadata = scene_metadata(scene, appearance_of(scene, shading, albedo))
    if shaded and only not in DATA:
        metadata |= shading_metadata(shaded.appearance, only)
    metadata |= settings
    if only == "parts":
        metadata["parts"] = ", ".join(part.name for part in scene.mesh.parts)
    return metadata


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
