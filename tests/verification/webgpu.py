"""WebGPU on the system's Vulkan driver, by wgpu; its compiler naga reads GLSL, WGSL and SPIR-V."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

TRIANGLE = """#version 450
void main() {
    gl_Position = vec4(vec2(gl_VertexIndex & 1, gl_VertexIndex >> 1) * 4.0 - 1.0, 0.0, 1.0);
}
"""  # covers the target


class Device:
    """A device that draws one triangle over a float target.

    Attributes
    ----------
    renderer, version : strings that the driver reports
    """

    def __init__(self) -> None:
        os.environ.setdefault("XDG_RUNTIME_DIR", "/tmp")  # unset, Mesa prints an error
        os.environ["WGPU_BACKEND_TYPE"] = "Vulkan"
        import wgpu

        self._wgpu: Any = wgpu
        self._device = wgpu.gpu.request_adapter_sync(
            force_fallback_adapter=True
        ).request_device_sync()
        info = self._device.adapter.info
        self.renderer, self.version = (
            info["device"],
            f"{info['description']}, wgpu {wgpu.__version__}",
        )
        self._pipeline = lru_cache(16)(self._new_pipeline)  # hill climbs reuse a few shaders

    def compile(self, fragment: str | bytes) -> None:
        """Translate a shader without drawing.

        Raises
        ------
        wgpu.GPUError : the shader is not valid
        """
        self._device.create_shader_module(label="compiled frag", code=fragment)

    def draw(
        self,
        fragment: str | bytes,
        size: tuple[int, int],
        inputs: Sequence[NDArray[np.float32]] = (),
    ) -> NDArray[np.float32]:
        """Return the image of a fragment shader, (height, width, 4), row 0 at y = 0.

        fragment : GLSL 450, WGSL or SPIR-V
        inputs : images with 1 or 3 components, in the order of their bindings
        """
        wgpu, device = self._wgpu, self._device
        width, height = size
        usage = wgpu.TextureUsage.RENDER_ATTACHMENT | wgpu.TextureUsage.COPY_SRC
        target = device.create_texture(size=(width, height, 1), format="rgba32float", usage=usage)
        group, pipeline = self._pipeline(fragment, len(inputs))
        encoder = device.create_command_encoder()
        clear = {"load_op": "clear", "store_op": "store", "clear_value": (0, 0, 0, 0)}
        drawing = encoder.begin_render_pass(
            color_attachments=[{"view": target.create_view(), **clear}]
        )
        drawing.set_pipeline(pipeline)
        views = [self._texture(image).create_view() for image in inputs]
        entries = [{"binding": i, "resource": view} for i, view in enumerate(views)]
        drawing.set_bind_group(0, device.create_bind_group(layout=group, entries=entries))
        drawing.draw(3)
        drawing.end()
        device.queue.submit([encoder.finish()])
        data = device.queue.read_texture(
            {"texture": target}, {"bytes_per_row": width * 16}, (width, height, 1)
        )
        return np.frombuffer(data, np.float32).reshape(height, width, 4)

    def _texture(self, image: NDArray[np.float32]) -> Any:
        """Return a texture of four components; as in OpenGL, a missing alpha is 1."""
        height, width, components = image.shape
        texels = np.broadcast_to(np.array([0, 0, 0, 1], np.float32), (height, width, 4)).copy()
        texels[..., :components] = image
        usage = self._wgpu.TextureUsage.TEXTURE_BINDING | self._wgpu.TextureUsage.COPY_DST
        size = width, height, 1
        texture = self._device.create_texture(size=size, format="rgba32float", usage=usage)
        layout = {"bytes_per_row": 16 * width, "rows_per_image": height}
        self._device.queue.write_texture({"texture": texture}, texels, layout, size)
        return texture

    def _new_pipeline(self, fragment: str | bytes, inputs: int) -> tuple[Any, Any]:
        """Return the bind group layout of the inputs, and the pipeline."""
        wgpu, device = self._wgpu, self._device
        stages = [
            device.create_shader_module(label="triangle vert", code=TRIANGLE),
            device.create_shader_module(label="drawn frag", code=fragment),
        ]
        texture = {"sample_type": "unfilterable-float"}
        read = {"visibility": wgpu.ShaderStage.FRAGMENT, "texture": texture}
        group = device.create_bind_group_layout(
            entries=[{"binding": i, **read} for i in range(inputs)]
        )
        pipeline = device.create_render_pipeline(
            layout=device.create_pipeline_layout(bind_group_layouts=[group]),
            vertex={"module": stages[0], "entry_point": "main"},
            fragment={
                "module": stages[1],
                "entry_point": "main",
                "targets": [{"format": "rgba32float"}],
            },
            primitive={"topology": "triangle-list"},
        )
        return group, pipeline
