"""The program under test: a custom renderer with moderngl."""

from pathlib import Path

import moderngl
import numpy as np

import facerender

VERTEX = """#version 330 core
out vec2 p;
void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    p = corner / 0.9;
    gl_Position = vec4(corner, 0.0, 1.0);
}
"""


class Skin:
    """Renderer of a sphere of skin.

    Attributes
    ----------
    facts : name and version of the driver, for the metadata of every image
    """

    def __init__(self, size: int = 160) -> None:
        self.gl = moderngl.create_context(standalone=True, backend="egl")
        facerender.moderngl_includes(self.gl)
        fragment = Path(__file__).with_name("skin.frag").read_text()
        self.program = self.gl.program(VERTEX, fragment)
        self.target = self.gl.framebuffer([self.gl.renderbuffer((size, size), 4, dtype="f4")])
        self.triangle = self.gl.vertex_array(self.program, [])
        self.facts = {name: self.gl.info[name] for name in ("GL_RENDERER", "GL_VERSION")}

    def draw(self, m: float = 0.3, specular_weight: float = 1.0) -> np.ndarray:
        """Return linear RGB and coverage, (H, W, 4) float32, row 0 at the top."""
        self.program["m"] = m
        self.program["specular_weight"] = specular_weight
        self.target.use()
        self.triangle.render(vertices=3)
        pixels = np.frombuffer(self.target.read(components=4, dtype="f4"), np.float32)
        return pixels.reshape(*self.target.size[::-1], 4)[::-1]
