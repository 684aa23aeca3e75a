"""Stand-ins of face models, with the same numbers of vertices, faces and texture coordinates, and
the same axes and units. The models themselves must not be distributed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

Arrays = dict[str, np.ndarray]


def head(rings: int, columns: int, vertices: int, faces: int, texture: int, size: float) -> Arrays:
    """Return v_template, f, vt and ft of an egg with a nose, y up, facing +z.

    Parameters
    ----------
    rings, columns : numbers of the grid of vertices, without poles
    vertices, faces, texture : rows of v_template, f and vt; further vertices are not used
    size : height of the egg
    """
    v, u = (a.ravel() for a in np.mgrid[:rings, : columns + 1])
    down, around = np.pi * (v + 1) / (rings + 1), 2 * np.pi * u / columns
    x, z = np.sin(down) * np.sin(around), np.sin(down) * np.cos(around)
    egg = np.stack([0.35 * x, 0.5 * np.cos(down), 0.4 * z], axis=1)
    nose = np.exp(-(egg[:, 0] ** 2 + (egg[:, 1] + 0.05) ** 2) / 0.004) * (egg[:, 2] > 0)
    egg[:, 2] += 0.1 * nose
    uv = np.stack([u / columns, 1 - (v + 1) / (rings + 1)], axis=1)
    poles, pole_uv = [(0, 0.5, 0), (0, -0.5, 0)], [(0.5, 1), (0.5, 0)]
    at = np.arange(rings * (columns + 1)).reshape(rings, columns + 1)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    top, bottom = at.size, at.size + 1
    ft = np.concatenate(
        [
            np.stack([np.full(columns, top), at[0, :-1], at[0, 1:]], axis=1),
            np.stack([a, c, b], axis=-1).reshape(-1, 3),
            np.stack([b, c, d], axis=-1).reshape(-1, 3),
            np.stack([at[-1, :-1], np.full(columns, bottom), at[-1, 1:]], axis=1),
        ]
    )
    welded = np.append((v * columns + u % columns), rings * columns + np.arange(2))
    places = np.zeros((vertices, 3))
    places[welded] = np.concatenate([egg, poles])
    coordinates = np.zeros((texture, 2))
    coordinates[: len(uv) + 2] = np.concatenate([uv, pole_uv])
    return {
        "v_template": size * places,
        "f": welded[ft][:faces],
        "vt": coordinates,
        "ft": ft[:faces],
    }


def write_obj(path: Path, model: Arrays, positions: np.ndarray) -> None:
    """Write a model with other positions as an OBJ file."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in positions.tolist()]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in model["vt"].tolist()]
    pairs = np.stack([model["f"], model["ft"]], axis=-1) + 1
    lines += ["f " + " ".join(f"{v}/{t}" for v, t in face) for face in pairs.tolist()]
    path.write_text("\n".join(lines))


def write_all(folder: Path) -> None:
    """Write the files that docs/moving.md reads."""
    flame = head(50, 100, 5_023, 9_976, 5_118, 0.28)
    np.savez(folder / "flame_model.npz", v_template=flame["v_template"], f=flame["f"])
    mean = np.full((64, 64, 3), (220, 170, 150), dtype=np.uint8)
    np.savez(folder / "FLAME_texture.npz", vt=flame["vt"], ft=flame["ft"], mean=mean)
    body = head(51, 205, 10_475, 20_908, 11_313, 1.7)
    np.savez(folder / "SMPLX_NEUTRAL.npz", **body)  # type: ignore[arg-type]
    steps = np.linspace(0.0, 0.1, 2)[:, None, None]
    np.save(folder / "poses.npy", body["v_template"] + steps * (1.0, 0.0, 0.0))
    ict = head(130, 205, 26_719, 53_300, 26_912, 25.0)
    for name, scale in (("generic_neutral_mesh", 1.0), ("jawOpen", 1.02)):
        write_obj(folder / f"{name}.obj", ict, ict["v_template"] * (1.0, scale, 1.0))
