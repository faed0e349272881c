"""Visible shapes of a MuJoCo model and the poses of its bodies, for viewers that draw with something else."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

VISIBLE_GROUPS = 3  # MuJoCo's viewers show the geom groups 0 to 2
KINDS: dict[int, str] = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): "plane",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
}

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """One geom: its appearance and its pose on the body."""

    body: int
    kind: str  # plane, sphere, capsule, cylinder, box or mesh
    size: tuple[float, float, float]  # [m], as MuJoCo has it: radius, half lengths
    rgba: tuple[float, float, float, float]
    position: Vector  # [m], (3,), in the body's frame
    wxyz: Vector  # (4,), a quaternion
    vertices: Vector | None = None  # [m], (n, 3), of a mesh
    faces: NDArray[np.int32] | None = None  # (m, 3)


@dataclass(frozen=True)
class Poses:
    """Positions of bodies in the world, a row each."""

    positions: Vector  # [m], (n, 3)
    wxyz: Vector  # (n, 4)

    def towards(self, other: Poses, share: float) -> Poses:
        """Return poses interpolated by a share (0 .. 1) towards `other`; quaternions along the chord."""
        nearer = np.where((self.wxyz * other.wxyz).sum(axis=1, keepdims=True) < 0.0, -other.wxyz, other.wxyz)
        wxyz = self.wxyz + share * (nearer - self.wxyz)
        positions = self.positions + share * (other.positions - self.positions)
        return Poses(positions, wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True))


def visible_shapes(model: mujoco.MjModel) -> list[Shape]:
    """Return a model's visible shapes; kinds of geoms that our models do not have are left out."""
    return [
        _shape(model, geom)
        for geom in range(model.ngeom)
        if model.geom_group[geom] < VISIBLE_GROUPS and int(model.geom_type[geom]) in KINDS
    ]


def moving_bodies(model: mujoco.MjModel) -> list[int]:
    """Return the bodies that are not fixed to the world: those behind a joint, and those that are placed."""
    return [body for body in range(model.nbody) if model.body_weldid[body] != 0 or model.body_mocapid[body] >= 0]


def body_poses(data: mujoco.MjData, bodies: list[int]) -> Poses:
    """Return a copy of the bodies' poses."""
    return Poses(data.xpos[bodies].copy(), data.xquat[bodies].copy())


def _shape(model: mujoco.MjModel, geom: int) -> Shape:
    material = int(model.geom_matid[geom])
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    vertices, faces = None, None
    if KINDS[int(model.geom_type[geom])] == "mesh":
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        vertices = model.mesh_vert[first : first + count].astype(np.float64)
        first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        faces = model.mesh_face[first : first + count].copy()
    x, y, z = model.geom_size[geom].tolist()
    red, green, blue, alpha = rgba.tolist()
    return Shape(
        body=int(model.geom_bodyid[geom]),
        kind=KINDS[int(model.geom_type[geom])],
        size=(x, y, z),
        rgba=(red, green, blue, alpha),
        position=model.geom_pos[geom].copy(),
        wxyz=model.geom_quat[geom].copy(),
        vertices=vertices,
        faces=faces,
    )
