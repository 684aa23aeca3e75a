"""Measure the errors of lighting by environment maps, for docs/measurements/skin.md.

    python -m benchmarks.skin_environment

Compares specular light from few samples with many samples, and diffuse light from nine
coefficients with the whole panorama. Compares images with and without the shadows of the
environment with rays. Counts bright dots of highlights narrower than a pixel. Writes
docs/measurements/skin_environment.json in 8 minutes.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import facerender as fr
from benchmarks.data import meshes, save
from benchmarks.prices import table
from facerender.drawing import reference
from facerender.images.image import encode_srgb8
from facerender.scene.environment import studio
from facerender.terms.environment import environment_irradiance
from facerender.values.vectors import direction_to
from tests.verification.environment import Traced, overcast
from tests.verification.scan import TEST_DATA

Float = NDArray[np.float64]

SIZE, MANY, DIRECTIONS = 192, 4096, 4096
COUNTS, SLOPES = (8, 16, 32, 64), (0.15, 0.3, 0.5)


@dataclass(frozen=True)
class SampleError:
    """Errors of an image under an environment map, over its covered pixels.

    Attributes
    ----------
    of_all : mean absolute error, relative to the mean of the image
    of_specular : mean absolute error, relative to the mean of the specular part
    energy : mean signed error, relative to the mean of the specular part
    displayed : 99th percentile of the error in levels
    """

    of_all: float
    of_specular: float
    energy: float
    displayed: float


def sky(rows: int = 512) -> fr.Panorama:
    """Return a clear sky over grey ground, with a sun of 4 degrees."""
    directions = panorama_directions(rows)
    height = directions[..., 1]
    radiance = np.where(height > 0.0, 0.4 + 0.8 * (1.0 - np.abs(height)) ** 3, 0.25)
    away = 1.0 - directions @ direction_to(-50.0, 40.0)
    radiance = radiance + 900.0 * np.exp(-away / 3e-4)
    return fr.Panorama("sky and sun", radiance[..., None] * [1.0, 0.95, 0.9])


def panorama_directions(rows: int) -> Float:
    """Return the direction of each value of a panorama, unit vectors (rows, 2 rows, 3)."""
    elevation = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    azimuth = np.pi * (1.0 - (np.arange(2 * rows) + 0.5) / rows)
    across, up = np.cos(elevation), np.sin(elevation) + 0.0 * azimuth
    return np.stack([across * np.sin(azimuth), up, across * np.cos(azimuth)], axis=-1)


def diffuse_error(panorama: fr.Panorama, count: int = 400) -> tuple[float, float]:
    """Return the mean and the largest error of the irradiance from nine coefficients.

    Both are over ``count`` random directions, relative to the mean irradiance.
    """
    n = np.random.default_rng(1).normal(size=(count, 3))
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    rows = len(panorama.radiance)
    directions = panorama_directions(rows).reshape(-1, 3)
    solid_angle = np.sqrt(1.0 - directions[:, 1:2] ** 2) * (np.pi / rows) ** 2
    received = panorama.radiance.reshape(-1, 3) * solid_angle
    expected = np.array([np.maximum(directions @ each, 0.0) @ received for each in n])
    error = np.abs(environment_irradiance(panorama.coefficients, n) - expected)
    return float(error.mean() / expected.mean()), float(error.max() / expected.mean())


def sample_errors(
    renderer: fr.Renderer, scene: fr.Scene, counts: tuple[int, ...] = COUNTS
) -> dict[int, SampleError]:
    """Return the errors by the number of samples, against an image with MANY samples."""
    covered = renderer.gbuffer(scene).part >= 0

    def image(count: int) -> Float:
        shading = fr.Shading(environment_samples=count, environment_lights=0)
        return renderer.render(scene, shading).linear[covered][:, :3].astype(np.float64)

    many = image(MANY)
    specular = many - image(0)
    errors = {}
    for count in counts:
        few = image(count)
        error = np.abs(few - many)
        shown = [encode_srgb8(each.astype(np.float32)).astype(float) for each in (few, many)]
        errors[count] = SampleError(
            float(error.mean() / many.mean()),
            float(error.mean() / specular.mean()),
            float((few - many).mean() / specular.mean()),
            float(np.quantile(np.abs(np.subtract(*shown)).max(axis=-1), 0.99)),
        )
    return errors


def ray_errors() -> list[dict[str, Any]]:
    """Return the errors against rays without and with the shadows of the environment."""
    heads = dict(meshes())
    if (path := TEST_DATA / "faces" / "ICT-FaceKit" / "generic_neutral_mesh.obj").is_file():
        heads["ICT-FaceKit"] = fr.load_mesh(path)
    rows = []
    with fr.Renderer(SIZE, samples=1, float_albedo=True) as renderer:
        for name, mesh in heads.items():
            scene = fr.Scene(mesh, fr.Camera(frame="face"), (), 0.0, environment="studio")
            traced = Traced(renderer, scene, DIRECTIONS)
            for panorama in (studio(), sky(), overcast()):
                environment = fr.Environment(panorama)
                expected = traced.radiance(environment, fr.Shading())
                for count in (0, 8):
                    shading = fr.Shading(environment_lights=count)
                    error = asdict(traced.error(environment, shading, expected))
                    texts = {"mesh": name, "environment": panorama.name, "lights": count}
                    rows.append({**texts, **{key: round(value, 2) for key, value in error.items()}})
                    print(*rows[-1].values(), flush=True)
    return rows


def sparkle(size: int = 384) -> dict[str, int]:
    """Return numbers of pixels that differ by more than 32 levels from an image of 6 times the size
    that is scaled down, keyed by the name of a setting."""
    scene = fr.Scene(fr.load_mesh(), fr.Camera("three-quarter"), environment="studio")

    def image(scale: int, samples: int) -> NDArray[np.int64]:
        with fr.Renderer((scale * size, scale * size), samples=samples) as renderer:
            shading = fr.Shading(environment_lights=0)
            linear = renderer.render(scene, shading).linear[..., :3]
        mean = linear.reshape(size, scale, size, scale, 3).mean(axis=(1, 3))
        return encode_srgb8(mean).astype(np.int64)

    expected = image(6, 4)
    images = {
        "1 sample": image(1, 1),
        "4 samples": image(1, 4),
        "16 samples": image(1, 16),
        "4 samples, twice the size, scaled down": image(2, 4),
    }
    errors = {name: np.abs(own - expected).max(axis=-1) for name, own in images.items()}
    return {name: int((error > 32).sum()) for name, error in errors.items()}


def float64_error(renderer: fr.Renderer, scene: fr.Scene, shading: fr.Shading) -> float:
    """Return the largest error against float64, relative to the reference but at least to 0.01."""
    gbuffer = renderer.gbuffer(scene, shading)
    covered = gbuffer.part >= 0
    expected = reference.shade(gbuffer, scene, shading)[covered]
    image = renderer.render(scene, shading).linear[covered][:, :3]
    return float((np.abs(image - expected) / np.maximum(expected, 0.01)).max())


def main() -> None:
    panoramas = [studio(), sky()]
    diffuse = {
        each.name: dict(zip(("mean", "largest"), diffuse_error(each), strict=True))
        for each in panoramas
    }
    rows, worst = [], 0.0
    with fr.Renderer((SIZE, SIZE), samples=1) as renderer:
        for name, mesh in meshes():
            for panorama in panoramas:
                bare = fr.Scene(mesh, fr.Camera(-35.0, zoom=1.3), (), 0.0, None)
                scene = replace(bare, environment=fr.Environment(panorama, 20.0))
                worst = max(worst, float64_error(renderer, scene, fr.Shading()))
                for m in SLOPES:
                    smooth = replace(scene, mesh=mesh.with_material(m=m))
                    errors = sample_errors(renderer, smooth)
                    lost = {str(count): asdict(error) for count, error in errors.items()}
                    rows.append({"mesh": name, "environment": panorama.name, "m": m, "lost": lost})
                    print(name, panorama.name, m, errors[32], flush=True)
    parts = table.parts("navi21")
    cycles = {"sample": parts["environment sample"], "base": parts["environment"]}
    save(
        "skin_environment",
        diffuse=diffuse,
        samples=rows,
        float64=worst,
        rays=ray_errors(),
        sparkle=sparkle(),
        cycles={name: round(value) for name, value in cycles.items()},
    )


if __name__ == "__main__":
    main()
