"""Rays from a camera to the triangles of a mesh, in float64, without the renderer."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

import facerender as fr
from facerender.batch.outputs import camera_record
from facerender.mesh.mesh import drawn_alpha

Float = NDArray[np.float64]
Size = tuple[int, int]


def camera_of(scene: fr.Scene, size: Size) -> tuple[Float, Float]:
    """Return the matrices K and [R|t] of a scene's camera."""
    facts = camera_record(fr.view_of(scene, size[0] / size[1]), scene.mesh, size)
    return np.array(facts["K"]), np.array(facts["Rt"])


def by_opencv(points: Float, camera: tuple[Float, Float]) -> Float:
    """Return the pixels (N, 2) of points in front of a camera; OpenCV projects them."""
    k, pose = camera
    shift = pose[:, :3].T @ pose[:, 3]  # OpenCV loses digits of meshes far from the origin
    turn, _ = cv2.Rodrigues(pose[:, :3])
    found, _ = cv2.projectPoints((points + shift)[:, None], turn, np.zeros(3), k, None)
    return np.asarray(found[:, 0], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Surface:
    """The triangles of all parts that are not blended.

    Attributes
    ----------
    corners : (F, 3, 3)
    single_sided : (F,), whether only the front of a triangle is drawn
    part, face : (F,), the index of the part, and of the triangle in the part
    """

    corners: Float
    single_sided: NDArray[np.bool_]
    part: NDArray[np.int64]
    face: NDArray[np.int64]

    @classmethod
    def of(cls, mesh: fr.Mesh) -> Surface:
        pairs = enumerate(zip(mesh.parts, mesh.materials, strict=True))
        drawn = [(i, p, m) for i, (p, m) in pairs if drawn_alpha(p, m) != "blend"]
        return cls(
            np.concatenate([p.positions[p.faces] for _, p, _ in drawn]),
            np.concatenate([np.full(len(p.faces), m.double_sided is False) for _, p, m in drawn]),
            np.concatenate([np.full(len(p.faces), i) for i, p, _ in drawn]),
            np.concatenate([np.arange(len(p.faces)) for _, p, _ in drawn]),
        )

    def points(self, count: int, seed: int) -> tuple[Float, NDArray[np.int64]]:
        """Return random points, evenly distributed by area, and the triangle of each."""
        rng = np.random.default_rng(seed)
        a, b, c = self.corners.transpose(1, 0, 2)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        chosen = rng.choice(len(areas), count, p=areas / areas.sum())
        weights = rng.dirichlet(np.ones(3), count)
        return np.einsum("ni,nij->nj", weights, self.corners[chosen]), chosen

    def hit(
        self, pixels: Float, camera: tuple[Float, Float]
    ) -> tuple[Float, NDArray[np.int64], Float]:
        """Return what the rays through pixels (N, 2) hit first: the depth along the viewing
        direction (inf for nothing), the triangle, and the barycentric coordinates (N, 3)."""
        k, pose = camera
        rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(k).T
        corners = self.corners @ pose[:, :3].T + pose[:, 3]  # camera space
        a, b, c = corners.transpose(1, 0, 2)
        normals = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
        volumes = np.einsum("fi,fi->f", a, normals[0])
        # Camera space has y down, but is right-handed: front faces have negative volumes.
        normals = np.where(((volumes > 0) & self.single_sided)[:, None], np.nan, normals)
        depth, index = np.full(len(rays), np.inf), np.zeros(len(rays), np.int64)
        weights = np.zeros((len(rays), 3))
        with np.errstate(all="ignore"):
            for start in range(0, len(rays), 64):
                own = slice(start, start + 64)
                parts = rays[own] @ normals.transpose(0, 2, 1)  # (3, rays, F)
                sums = parts.sum(axis=0)
                inside = ((parts * np.sign(sums)) >= 0.0).all(axis=0)
                far = np.where(inside, volumes / sums, np.inf)
                far[~(far > 0.0)] = np.inf
                index[own] = far.argmin(axis=1)
                rows = np.arange(far.shape[0])
                depth[own] = far[rows, index[own]]
                weights[own] = (parts[:, rows, index[own]] / sums[rows, index[own]]).T
        return depth, index, weights
