"""A structured-light scanner by ray casting: what camera and projector both see, with its noise."""

import ctypes
import sys
from dataclasses import dataclass
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from simulators.rig import Rig, about_z, apply, inverse
from simulators.solids import Floats, Ints

if sys.platform == "linux":
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)

import open3d

__all__ = ["BlindSpot", "OpticsSettings", "Rig", "StructuredLight", "about_z"]

Bools = NDArray[np.bool_]
STATED_INCIDENCE_DEG = 45.0
MISS = open3d.t.geometry.RaycastingScene.INVALID_ID


@dataclass(frozen=True, slots=True, kw_only=True)
class BlindSpot:
    """A ball (part frame) in which the surface is too dirty or too bright to be measured."""

    centre_mm: tuple[float, float, float]
    radius_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class OpticsSettings:
    """What the scanner can do.

    `noise_normal_mm`: standard deviation along the surface normal at 45 degrees incidence; it grows
    with the secant of the incidence by `noise_growth`. `flying` is the share of pixels on a depth edge
    that report a point in mid air, `dropout` the share of good pixels lost at random.
    """

    noise_normal_mm: float = 0.012
    noise_growth: float = 0.25
    max_incidence_deg: float = 72.0
    flying: float = 0.02
    dropout: float = 0.005
    blind: tuple[BlindSpot, ...] = ()

    def __post_init__(self) -> None:
        sizes = (self.noise_normal_mm, self.noise_growth, self.flying, self.dropout)
        if not all(isfinite(size) and size >= 0.0 for size in sizes):
            raise ValueError(f"optics: noise, growth, flying and dropout {sizes} are not zero or more")
        if not 0.0 < self.max_incidence_deg < 90.0:
            raise ValueError(f"optics: an incidence limit of {self.max_incidence_deg} deg sees nothing")


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """The pixels whose ray met the part: indices, distance along the ray, and the face met."""

    pixel: Ints
    distance_mm: Floats
    normal: Floats


class StructuredLight:
    """The scanner in front of one part on the turntable."""

    def __init__(
        self,
        vertices_mm: Floats,
        faces: Ints,
        T_table_part: Floats,
        rig: Rig,
        settings: OpticsSettings | None = None,
    ) -> None:
        self.rig = rig
        self.settings = settings or OpticsSettings()
        self._T_table_part = np.array(T_table_part)
        self._vertices_mm = vertices_mm @ T_table_part[:3, :3].T + T_table_part[:3, 3]
        self._faces = np.asarray(faces, dtype=np.int64)
        self._normals = _face_normals(self._vertices_mm, self._faces)
        self._directions = rig.directions().reshape(-1, 3)
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            open3d.core.Tensor.from_numpy(np.ascontiguousarray(self._vertices_mm, dtype=np.float32)),
            open3d.core.Tensor.from_numpy(np.ascontiguousarray(self._faces, dtype=np.uint32)),
        )

    def capture(self, table_angle_deg: float, rng: np.random.Generator) -> Floats:
        """The range image (rows, columns, 3) in the scanner frame, mm; NaN where nothing was measured."""
        T_table_scanner = inverse(self.rig.T_scanner_table0 @ about_z(table_angle_deg))
        camera = apply(T_table_scanner, self.rig.camera_mm[None])[0]
        projector = apply(T_table_scanner, self.rig.projector_mm[None])[0]
        directions = self._directions @ T_table_scanner[:3, :3].T
        hits = self._cast(camera, directions)
        points = camera + hits.distance_mm[:, None] * directions[hits.pixel]
        incidence = -np.einsum("ij,ij->i", directions[hits.pixel], hits.normal)
        seen = self._measurable(points, hits.normal, incidence, projector)
        distance = hits.distance_mm + self._noise_mm(incidence, rng)
        return self._image(hits.pixel, distance, seen, rng)

    def _cast(self, camera: Floats, directions: Floats) -> _Hits:
        """The first face on each ray by Open3D, its plane met again in float64."""
        rays = np.concatenate([np.broadcast_to(camera, directions.shape), directions], axis=1)
        answer = self._scene.cast_rays(open3d.core.Tensor.from_numpy(rays.astype(np.float32)))
        face = answer["primitive_ids"].numpy()
        pixel = np.flatnonzero(face != MISS)
        normal = self._normals[face[pixel]]
        corner = self._vertices_mm[self._faces[face[pixel], 0]]
        ahead = np.einsum("ij,ij->i", directions[pixel], normal)
        facing = ahead < -1e-6
        pixel, normal, corner, ahead = pixel[facing], normal[facing], corner[facing], ahead[facing]
        return _Hits(pixel, np.einsum("ij,ij->i", corner - camera, normal) / ahead, normal)

    def _measurable(self, points: Floats, normal: Floats, incidence: Floats, projector: Floats) -> Bools:
        to_light = projector - points
        lit = np.einsum("ij,ij->i", to_light, normal) / np.linalg.norm(to_light, axis=1)
        limit = np.cos(np.radians(self.settings.max_incidence_deg))
        seen: Bools = (incidence > limit) & (lit > limit) & (points[:, 2] > self.rig.seat_mm)
        for spot in self.settings.blind:
            centre = apply(self._T_table_part, np.array(spot.centre_mm)[None])[0]
            seen &= np.linalg.norm(points - centre, axis=1) > spot.radius_mm
        index = np.flatnonzero(seen)
        seen[index] = ~self._shadowed(points[index] + 2e-3 * normal[index], to_light[index])
        return seen

    def _shadowed(self, points: Floats, to_light: Floats) -> Bools:
        rays = np.concatenate([points, to_light], axis=1).astype(np.float32)
        shadow: Bools = self._scene.test_occlusions(
            open3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=1.0
        ).numpy()
        return shadow

    def _noise_mm(self, incidence: Floats, rng: np.random.Generator) -> Floats:
        """Noise along the ray: its part along the normal has the standard deviation of the settings."""
        stated = 1.0 / np.cos(np.radians(STATED_INCIDENCE_DEG))
        steep = 1.0 / np.maximum(incidence, 0.05)
        growth = 1.0 + self.settings.noise_growth * (steep - stated)
        noise: Floats = rng.normal(0.0, self.settings.noise_normal_mm, len(incidence)) * growth * steep
        return noise

    def _image(self, pixel: Ints, distance: Floats, seen: Bools, rng: np.random.Generator) -> Floats:
        depth = np.full(self.rig.rows * self.rig.columns, np.nan)
        depth[pixel[seen]] = distance[seen]
        self._fly(depth.reshape(self.rig.rows, self.rig.columns), rng)
        depth[rng.random(len(depth)) < self.settings.dropout] = np.nan
        image = self.rig.camera_mm + depth[:, None] * self._directions
        return image.reshape(self.rig.rows, self.rig.columns, 3)

    def _fly(self, depth: Floats, rng: np.random.Generator) -> None:
        """Put a few pixels beside a depth edge between the two surfaces that share them."""
        left, right = depth[:, :-1], depth[:, 1:]
        edge = np.argwhere(np.abs(left - right) > 10.0 * self.rig.pitch_mm)
        chosen = edge[rng.random(len(edge)) < self.settings.flying]
        weight = rng.uniform(0.1, 0.9, len(chosen))
        row, column = chosen.T
        depth[row, column] += weight * (depth[row, column + 1] - depth[row, column])


def _face_normals(vertices_mm: Floats, faces: Ints) -> Floats:
    a, b, c = vertices_mm[faces.T]
    cross = np.cross(b - a, c - a)
    normals: Floats = cross / np.maximum(np.linalg.norm(cross, axis=1), 1e-300)[:, None]
    return normals
