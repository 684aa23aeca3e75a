"""The renderer, which draws the passes of a scene and reads the image back as float32."""

from __future__ import annotations

import math
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
from facerender.drawing import frame_passes, prepare
from facerender.drawing.compiled import CompiledFrame, sized
from facerender.drawing.context import Backend, create_context
from facerender.drawing.frame import (
    PLANES_OF,
    Frame,
    GBuffer,
    LazyMetadata,
    check_images,
    data_image,
    frame_metadata,
    in_order,
)
from facerender.drawing.frame_passes import Layer, Structure
from facerender.drawing.maps import Maps
from facerender.drawing.prepare import Appearance, ResolvedPart, ResolvedScene
from facerender.drawing.program import Pass, Target
from facerender.drawing.resources import Resources, free_dropped
from facerender.errors import ContextError, check_known, clipped
from facerender.images.image import ImageData
from facerender.loading import MeshSource, load_mesh
from facerender.mesh.hints import emit, emit_all, too_clear
from facerender.mesh.mesh import Mesh, drawn_alpha
from facerender.scene.background import (
    ENVIRONMENT,
    BackgroundSource,
    check_environment,
    clear_color,
    covering,
)
from facerender.scene.camera import Camera
from facerender.scene.environment import EnvironmentSource
from facerender.scene.job import ImageSettings, Job
from facerender.scene.light import Light
from facerender.scene.scene import DATA, ONLY, SHADING_RATES, Only, Scene, ShadingRate
from facerender.scene.shading import Shading
from facerender.scene.view import View, following, mm_per_pixel, sample_grid, view_of
from facerender.terms.lobe import AnyLobe
from facerender.texture.texture import Kind
from facerender.values.fields import MEMORY
from facerender.values.vectors import Vector

if TYPE_CHECKING:
    from facerender.drawing.lens import Lens
    from facerender.scene.landmarks import Landmarks

_MAX_FRAMES = 8  # compiled frames of an appearance
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
        it more often. Above this limit, the renderer averages shifted images with as many samples
        each as the driver allows: 16 samples are four images of 4 on Mesa
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
        width_height: Any = size  # one number stands for both
        image = ImageSettings(
            width_height, samples, anisotropy, float_albedo, full_maps, alpha_threshold
        )
        if memory is not None:
            MEMORY.check("memory", memory)
        self.size, self.samples, self.memory = image.size, image.samples, memory
        self.anisotropy, self.full_maps = image.anisotropy, image.full_maps
        self.alpha_threshold = image.alpha_threshold
        self.albedo_kind: Kind = "linear-color" if image.float_albedo else "color"
        # Depth peeling reads the target of the previous layer: other threads must not change it.
        self._layer_lock = threading.Lock()
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
        return cls(**vars(job.image), backend=backend, memory=memory)

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.release()

    def release(self) -> None:
        """Free all GPU objects, and the context unless the host owns it.

        Further calls have no effect, nor do calls in a process forked from the renderer's process.
        """
        self.context.release(self._resources.release)
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
        if only is not None:
            check_known("term", only, ONLY)
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
        check_known("shading rate", shading_rate, SHADING_RATES)
        names = (outputs,) if isinstance(outputs, str) else tuple(outputs)
        for name in names:
            check_known("output", name, ("image", *ONLY))
        samples = self.samples if samples is None else ImageSettings(samples=samples).samples
        if shading_rate == "pixel" and not self.can_shade_per_pixel(scene, samples, shading):
            shading_rate = "sample"
        images, shaded = self._images(scene, shading, names, samples, shading_rate)
        if "motion" in names:
            images["motion"] = self._motion(scene, shading.replace(shadow_lights=()))
        behind = self._behind(scene) if "image" in images else None
        if behind is not None:
            linear = images["image"]
            linear[..., :3] += (1.0 - linear[..., 3:]) * behind
        check_images(images, scene, self.alpha_threshold)
        if shaded:
            emit_all(shaded.scene.mesh)
        still = replace(scene, before=None) if scene.before else scene
        rate = {"shading_rate": shading_rate} if shading_rate == "pixel" else {}
        backs: dict[str, Any] = {}  # backgrounds that exposure and tone do not change
        if scene.background != ENVIRONMENT:
            backs["image"] = scene.background if behind is None else behind
        if scene.background != Scene.background:  # the albedo has other colours only
            backs["albedo"] = clear_color(scene.background)
        frames, warned = {}, scene.mesh.geometry.derived.setdefault("clipped", set())
        millimetres = mm_per_pixel(scene, self.size)
        for name in names:
            only: Any = None if name == "image" else name
            settings = {"samples": str(samples)} | rate | ({"only": name} if only else {})
            if name in DATA:
                threshold = str(self.alpha_threshold)
                settings = {"samples": "1", "only": name, "alpha_threshold": threshold}
            arguments = scene if name == "motion" else still, shading, only, self.albedo_kind
            make = partial(frame_metadata, *arguments, shaded, self.metadata | settings, self.size)
            look = scene.background is None, LazyMetadata(make), backs.get(name), warned
            frames[name] = Frame(images[name], only, *look, millimetres)
        return frames

    def _behind(self, scene: Scene) -> NDArray[np.float32] | None:
        """Return the image (H, W, 3) behind the mesh; None for a colour or a transparent image."""
        if isinstance(scene.background, ImageData):
            return covering(scene.background, self.size)
        check_environment(scene)
        if scene.environment is None or scene.background != ENVIRONMENT:
            return None
        from facerender.drawing.motion import pixel_centres

        lens, renderer, flat = self._undistorted(scene)
        positions = lens.positions if lens else pixel_centres(self.size)
        view = view_of(flat, renderer.size[0] / renderer.size[1])
        directions = view.directions(2.0 * positions / renderer.size - 1.0)
        return scene.environment.seen(directions.reshape(*self.size[::-1], 3))

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
        lens, wide, flat = self._undistorted(scene)
        scene = following(scene, view)
        if lens:
            flat_images, resolved = wide._images(flat, shading, outputs, samples, rate)
            for name, image in flat_images.items():
                images[name] = (lens.nearest_values if name in DATA else lens.filtered)(image)
            return images, resolved
        data: list[Any] = [name for name in DATA if name in outputs and name != "motion"]
        planes_of = {plane for only in data for plane in PLANES_OF[only]}
        names = tuple(plane for plane in frame_passes.PLANES if plane in planes_of)
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
            of = self._for_data(scene, shading.replace(shadow_lights=()), view)
            make = partial(frame_passes.plane_passes, of, names, image=False)
            planes = dict(zip(names, self._draw("data", of, names, make, view), strict=True))
        if "visibility" in data:
            first = next((i for i, light in enumerate(scene.lights) if light.shadow), None)
            of = self._for_data(scene, shading, view)
            if first in (shadowed := of.look.lighting.shadowed):
                planes["fraction"] = self._fractions(of, view)[..., shadowed.index(first)]
        for name in data:
            images[name] = data_image(name, planes, view, scene)
        return images, resolved

    def _for_data(self, scene: Scene, shading: Shading, view: View) -> Structure:
        """Return the structure of frames of a scene's data."""
        shading = shading.replace(environment_lights=0)
        resolved = self._resolved(scene, shading, view, _DATA_SAMPLES)
        return self._with_cut(self._structure(resolved, view, 1, refracts=False, scatters=False))

    def _with_cut(self, of: Structure) -> Structure:
        """Return a structure with the parts that only data images show: blended parts that do not
        transmit light get an alpha mask, and have a surface where their opacity is at least
        alpha_threshold. Many exporters mark a whole face as blended."""
        emit(of.mesh, too_clear, too_clear(of.mesh, self.alpha_threshold))
        cut = []
        for part in of.look.blended:
            if not part.material.transmission:
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
                planes = frame_passes.plane_passes(of, names, image=True) if names else []
                return [*frame_passes.image_passes(of, only), *planes]

            of = self._with_cut(of) if names else of
            return self._draw(f"image {only}", of, names, make, view)
        # Multisampling samples edges all over a pixel, but shades once. Shifts over the whole pixel
        # would sample the shading evenly, and blur the edges; shifts over half a pixel are nearest
        # to a larger image that is scaled down.
        most = self.context.most_samples
        count = math.ceil(of.samples / most)
        linear = np.zeros((*self.size[::-1], 4), dtype=np.float32)
        for number, shift in enumerate(0.5 * sample_grid(count)):
            shifted = view.shifted(shift, self.size, number)
            one = self._structure(resolved, shifted, most, only is None, only != "specular")
            linear += self._radiance(one, resolved, shifted, only)[0]
        linear /= count
        return [linear]

    def _motion(self, scene: Scene, shading: Shading) -> NDArray[np.float32]:
        """Return the motion vectors of a scene; see ``Frame.linear``."""
        from facerender.drawing.motion import check_before, motion_vectors, pixel_centres

        before, aspect = check_before(scene), self.size[0] / self.size[1]
        views = view_of(scene, aspect), view_of(before, aspect)
        lens, renderer, flat = self._undistorted(scene)
        view = view_of(flat, renderer.size[0] / renderer.size[1])
        of = renderer._for_data(flat, shading, view)
        parts = sorted((*of.look.unblended, *of.cut), key=lambda part: part.index)
        make = lambda: [frame_passes.triangle_pass(parts)]  # noqa: E731
        (triangles,) = renderer._draw("triangles", of, None, make, view)
        triangles = lens.nearest_values(triangles) if lens else triangles
        rays = 2.0 * (lens.positions if lens else pixel_centres(self.size)) / renderer.size - 1.0
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
        """
        from facerender.scene.landmarks import located

        positions = landmarks.positions(scene.mesh)
        depth = self.render(scene, only="depth").linear
        view = view_of(scene, self.size[0] / self.size[1])
        return located(view, scene.mesh, positions, depth)

    def can_shade_per_pixel(self, scene: Scene, samples: int, shading: Shading = Shading()) -> bool:
        """Return whether a frame with `samples` per pixel can have ``shading_rate="pixel"``.

        `samples` must be the driver's largest number of samples, and more than 1. The scene may
        have up to 16 million triangles. No part may have an alpha mask. Parts that are not blended
        must use one set of texture coordinates. No channel of the background may exceed 1000.
        """
        ImageSettings(samples=samples)  # checks the number
        look = prepare.resolve(scene, shading, self.albedo_kind).appearance
        background = clear_color(scene.background)
        return samples > 1 and self._defers(look.unblended, look, background, "pixel", samples)

    def gbuffer(self, scene: Scene, shading: Shading = Shading(), blended: bool = True) -> GBuffer:
        """Draw the G-buffer of a scene. For errors see :meth:`render`.

        Parameters
        ----------
        blended : whether to draw blended parts too, with one G-buffer for each of their layers;
            default true
        """
        view = view_of(scene, self.size[0] / self.size[1])
        lens, wide, flat = self._undistorted(scene)
        scene = following(scene, view)
        if lens:
            return lens.nearest(wide.gbuffer(flat, shading, blended), view)
        resolved = self._resolved(scene, shading, view, _DATA_SAMPLES)
        setups, look = scene.mesh.setups, resolved.appearance
        # The part whose nearest vertex has the largest depth is drawn first.
        depths = {p.index: (setups[p.index].positions @ view.forward).min() for p in look.blended}
        parts = sorted(depths, key=lambda index: -float(depths[index])) if blended else ()
        with self._layer_lock:
            layers = [layer for part in parts for layer in self._layers(resolved, view, part)]
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
        names = frame_passes.surface_images(scene, layer is not None)
        if layer and layer.index:
            number = 1 - layer.index % 2
            previous = Target((4,) * len(names), sampled=True, number=number)
            framebuffer = self._resources.targets[sized(previous, self.size)].framebuffer
            inputs["previous_layer"] = framebuffer.color_attachments[-1]  # type: ignore[assignment]
        make = partial(frame_passes.surface_passes, of, names, layer)
        surfaces = self._draw("surface", of, layer, make, view, inputs)
        images = dict(zip(names, surfaces, strict=True))
        position, normal, albedo, uv = (images[name] for name in names[:4])
        lobes, emitted, order = (images.get(name) for name in ("lobes", "emitted", "layer"))
        count = len(look.lighting.lights)
        visibilities = np.ones((*position.shape[:2], count), dtype=np.float32)
        if shadowed := look.lighting.shadowed:
            visibilities[..., shadowed] = self._fractions(of, view, layer, inputs)
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
        view: View,
        layer: Layer | None = None,
        inputs: Mapping[str, moderngl.Texture] = {},
    ) -> NDArray[np.float32]:
        """Return the visible fractions (H, W, lights) of all lights that cast shadows, in the order
        of ``Lighting.shadowed``."""
        make, key = partial(frame_passes.fraction_passes, of, layer), (layer, len(of.cut))
        fractions = self._draw("fractions", of, key, make, view, inputs)
        return np.concatenate(fractions, axis=-1)[..., : len(of.look.lighting.shadowed)]

    def _resolved(self, scene: Scene, shading: Shading, view: View, samples: int) -> ResolvedScene:
        """Simplify and resolve a scene, check the memory it needs, and start to decode its maps."""
        resolved = prepare.resolve(scene, shading, self.albedo_kind)
        keeps_maps = self.full_maps or self.albedo_kind == "linear-color"
        if not keeps_maps and resolved.appearance.large_maps:
            smaller = prepare.reduced(resolved, view, self.size, self.anisotropy)
            if smaller is not resolved.scene:
                resolved = prepare.resolve(smaller, shading, self.albedo_kind)
        at_once, look = min(samples, self.context.most_samples), resolved.appearance
        if self._checked.get(look, 0) < at_once:
            prepare.check_memory(resolved, self.size, at_once, self.memory)
            self._checked[look] = at_once
            self._resources.upload_reduced(look.parts)
            prepare.start_maps(look.parts)
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
        background = clear_color(scene.background)
        scattering = None
        if scatters and look.scatters:
            from facerender.scene.scattering import scattering_of

            scattering = scattering_of(scene, view, self.size)
        maps = Maps(look, mesh, view, self.size, refracts)
        defers = partial(self._defers, look.unblended, look, background)
        # Scattering with several samples also shades the centres of the pixels.
        counts = {count for count in (samples, 1) if defers(rate, count)}
        defers_data = 1 in counts if rate == "sample" else defers("sample", 1)
        values = background, samples, counts, rate, scattering
        return Structure(look, mesh, maps, *values, defers_data=defers_data)

    def _defers(
        self,
        parts: Sequence[ResolvedPart],
        look: Appearance,
        background: Vector,
        rate: ShadingRate,
        samples: int,
    ) -> bool:
        """Return whether to draw only visible triangles: if asked for the rate "pixel", and where
        it is cheaper. With other numbers of samples than 1 or its maximum, a driver may use more
        than requested without reporting how many.

        parts : that are not blended
        """
        context, all_parts = self.context, [part.part for part in look.parts]
        rows = context.gl.info["GL_MAX_TEXTURE_SIZE"]
        return (
            samples in (1, context.most_samples)
            and frame_passes.can_defer(parts, background, rows)
            and (
                rate == "pixel"
                or frame_passes.deferred_is_cheaper(all_parts, self.size, samples, context.renderer)
            )
        )

    def _undistorted(self, scene: Scene) -> tuple[Lens | None, Renderer, Scene]:
        """Return the lens of a scene's camera, and the renderer and the scene of its undistorted
        image. Without distortion: None, this renderer and the same scene.

        The renderer has the same context, geometry, maps and programs. The last one is cached;
        targets of earlier sizes are freed."""
        if scene.camera.distortion is None:
            return None, self, scene
        from facerender.drawing.lens import lens_of

        lens, resized = lens_of(scene.camera, self.size), self._resized
        size = lens.wide
        if resized is None or resized.size != size:
            old_size, resized = resized and resized.size, copy(self)
            resized.size, resized._resized = size, None
            resized._checked = WeakKeyDictionary()
            resized._check_size()
            with self._layer_lock, self.context.drawing() as gl:
                targets = self._resources.targets
                for target in [target for target in targets if target.size == old_size]:
                    del targets[target]
                self._resources.frames.clear()
                gl.gc()
            self._resized = resized
        return lens, resized, lens.undistorted(scene)

    # --- OpenGL ----------------------------------------------------------------------------------

    def _draw(
        self,
        name: str,
        of: Structure,
        key: Hashable,
        make: Callable[[], list[Pass]],
        view: View,
        inputs: Mapping[str, moderngl.Texture] = {},
    ) -> list[NDArray[np.float32]]:
        """Draw a frame, which is compiled on first use, and return its results.

        name, key : equal for frames of one structure and size with equal passes
        make : returns these passes
        inputs : further textures that passes read, by uniform name. Such a frame is not cached
        """
        environment = of.look.environment
        with self.context.drawing():
            self._resources.evict_unused()
            frames = self._resources.frames.setdefault(of.look, {})
            address = self.size, name, of.key, key
            frame = None if inputs else frames.pop(address, None)
            if frame is None:
                panorama = environment.panorama if environment else None
                frame = CompiledFrame(self._resources, make(), self.size, panorama, inputs)
            if not inputs:
                frames[address] = frame
                if len(frames) > _MAX_FRAMES:
                    del frames[next(iter(frames))]
            return frame.draw(view, of.mesh)


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
    background: BackgroundSource = Scene.background,
    environment: EnvironmentSource | None = None,
    only: Only | None = None,
    anonymous: str | None = None,
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
    camera, lights, ambient, background, environment, anonymous : see :class:`Scene`
    only : see :meth:`Renderer.render`
    """
    shading = Shading(model, lobe, fresnel, masking=masking, outside=outside)
    loaded = mesh if isinstance(mesh, Mesh) else load_mesh(mesh)
    if m is not None:
        loaded = loaded.with_skin(m=m)
    prepare.start_maps(prepare.resolved_parts(loaded))
    scene = Scene(loaded, camera, lights, ambient, background, environment, None, anonymous)
    with Renderer(size, samples=samples, backend=backend) as renderer:
        return renderer.render(scene, shading, only)
