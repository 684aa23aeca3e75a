"""A minimal script that renders the built-in head with moderngl, trimesh and Pillow, as a baseline.

    python benchmarks/minimal_moderngl.py MESH.glb OUT.png

Uses the same mesh, maps, lights, camera, shading and image as ``facerender render --samples 1``,
and no code of facerender.
"""

import math
import sys

import moderngl
import numpy as np
import trimesh
from PIL import Image

VERTEX = """#version 330 core
in vec3 in_position; in vec3 in_normal; in vec2 in_uv;
uniform mat4 view_projection;
out vec3 position; out vec3 normal; out vec2 uv;
void main() {
    position = in_position; normal = in_normal; uv = in_uv;
    gl_Position = view_projection * vec4(in_position, 1.0);
}
"""
FRAGMENT = """#version 330 core
in vec3 position; in vec3 normal; in vec2 uv;
uniform sampler2D albedo_map, normal_map, orm_map;
uniform vec3 eye, to_light[3], irradiance[3], ambient;
out vec4 color;
const float PI = 3.14159265, F0 = 0.028;
void main() {
    vec3 v = normalize(eye - position), n = normalize(normal);
    if (gl_FrontFacing && dot(n, v) < -0.25) n = -n;  // the image is drawn upside down
    vec3 px = dFdx(position), ay = cross(dFdy(position), n), ax = cross(n, px);
    vec2 ux = dFdx(uv), uy = dFdy(uv);
    vec3 t = ay * ux.x + ax * uy.x, b = ay * ux.y + ax * uy.y;
    float s = sign(dot(px, ay)) * inversesqrt(max(max(dot(t, t), dot(b, b)), 1e-30));
    vec3 texel = texture(normal_map, uv).xyz * 2.0 - 1.0;
    n = normalize(texel.x * s * t + texel.y * s * b + texel.z * n);
    vec3 albedo = texture(albedo_map, uv).rgb;
    vec3 orm = texture(orm_map, uv).rgb;
    float m = max(orm.g * orm.g, 1e-4);
    vec3 diffuse = ambient * orm.r, specular = vec3(0.0);
    for (int i = 0; i < 3; ++i) {
        vec3 l = to_light[i];
        float nl = dot(n, l), nv = dot(n, v);
        vec3 e = irradiance[i] * max(nl, 0.0);
        diffuse += e;
        if (min(nl, nv) > 0.0) {
            nl = max(nl, 1e-6);
            nv = max(nv, 1e-6);
            vec3 h = l + v;
            float hh = dot(h, h), nh = nl + nv;
            float u = 1.0 - 0.5 * sqrt(hh), u2 = u * u;
            float f = F0 + (1.0 - F0) * u2 * u2 * u;
            float g = min(1.0, 4.0 * nh * min(nl, nv) / hh);
            float tan2 = clamp(hh / (nh * nh) - 1.0, 0.0, 1e6), sec2 = 1.0 + tan2;
            float d = exp(-tan2 / (m * m)) * sec2 * sec2 / (4.0 * m * m);
            specular += e * f * g * d / (PI * nl * nv);
        }
    }
    color = vec4(albedo / PI * diffuse + specular, 1.0);
}
"""


def direction(azimuth, elevation):
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])


class Script:
    def __init__(self, path, samples=0, size=1024):
        mesh = next(iter(trimesh.load_scene(path, process=False).geometry.values()))
        positions = np.asarray(mesh.vertices)
        positions = positions - (positions.min(axis=0) + positions.max(axis=0)) / 2
        positions /= np.linalg.norm(positions, axis=1).max()
        self.ctx = ctx = moderngl.create_context(standalone=True, backend="egl")
        program = self.program = ctx.program(VERTEX, FRAGMENT)
        vertices = np.hstack([positions, mesh.vertex_normals, mesh.visual.uv]).astype("f4")
        layout = ("3f 3f 2f", "in_position", "in_normal", "in_uv")
        indices = ctx.buffer(np.asarray(mesh.faces).astype("i4"))
        self.mesh = ctx.vertex_array(program, [(ctx.buffer(vertices), *layout)], indices)
        material = mesh.visual.material
        for unit, (name, image, components, internal) in enumerate(
            (
                ("albedo_map", material.baseColorTexture, 4, 0x8C43),  # GL_SRGB8_ALPHA8
                ("normal_map", material.normalTexture, 3, None),
                ("orm_map", material.metallicRoughnessTexture, 3, None),
            )
        ):
            image = image.convert("RGBA" if components == 4 else "RGB")
            data = image.transpose(Image.Transpose.FLIP_TOP_BOTTOM).tobytes()
            texture = ctx.texture(image.size, components, data, internal_format=internal)
            texture.build_mipmaps()
            texture.use(unit)
            program[name] = unit
        lights = ((-50, 42, 3.6, 3.4, 3.1), (115, 33, 0.72, 0.75, 0.81), (50, 5, 0.34, 0.36, 0.4))
        program["to_light"].write(np.array([direction(*each[:2]) for each in lights], "f4"))
        program["irradiance"].write(np.array([each[2:] for each in lights], "f4"))
        program["ambient"] = (0.26, 0.28, 0.31)
        r, y = np.hypot(positions[:, 0], positions[:, 2]), positions[:, 1]
        self.tangent = tangent = math.tan(math.radians(12.5))
        side, top = r * math.hypot(1 / tangent, 1), abs(y) / tangent + r
        self.distance = 1.04 * max(side.max(), top.max())
        self.single = ctx.framebuffer(
            [ctx.renderbuffer((size, size), 4, dtype="f4")], ctx.depth_renderbuffer((size, size))
        )
        self.target = self.single
        if samples:
            self.target = ctx.framebuffer(
                [ctx.renderbuffer((size, size), 4, samples, dtype="f4")],
                ctx.depth_renderbuffer((size, size), samples=samples),
            )
        ctx.enable(moderngl.DEPTH_TEST)

    def frame(self, azimuth):
        z = direction(azimuth, 0)
        x = np.cross([0.0, 1.0, 0.0], z)
        eye = z * self.distance
        view = np.eye(4)
        view[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        view[3, :3] = -eye @ view[:3, :3]
        near, far = self.distance - 1, self.distance + 1
        projection = np.zeros((4, 4))
        projection[0, 0], projection[1, 1] = 1 / self.tangent, -1 / self.tangent
        projection[2, 2:] = -(far + near) / (far - near), -1
        projection[3, 2] = -2 * far * near / (far - near)
        self.program["view_projection"].write((view @ projection).astype("f4"))
        self.program["eye"].write(eye.astype("f4"))
        self.target.use()
        self.target.clear(0.012, 0.013, 0.016, 1.0)
        self.mesh.render()
        if self.target is not self.single:
            self.ctx.copy_framebuffer(self.single, self.target)
        data = self.single.read(components=4, dtype="f4")
        return np.frombuffer(data, "f4").reshape(*self.single.size[::-1], 4)


if __name__ == "__main__":
    linear = Script(sys.argv[1]).frame(0.0)[..., :3].clip(0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    Image.fromarray((srgb * 255 + 0.5).astype("u1")).save(sys.argv[2], compress_level=1)
