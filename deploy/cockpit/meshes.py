"""Meshes of a scene: a MuJoCo model's shapes, laser beams and the floor's lines.

They are small: if there is no graphics card, a frame takes as long as its triangles and its pixels do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import viser.transforms
from numpy.typing import NDArray

from rlservo.envs.shapes import Shape

BEAM_WIDTH = 0.012  # [m]
CELL_M, LINE_COLOUR = 0.5, (190, 194, 198)  # of the floor

Vector = NDArray[np.float64]


def shape_mesh(shape: Shape) -> Any:
    """Return a shape as a mesh in its body's frame."""
    x, y, z = shape.size
    if shape.kind == "sphere":
        mesh = trimesh.creation.icosphere(radius=x, subdivisions=2)
    elif shape.kind == "capsule":
        mesh = trimesh.creation.capsule(radius=x, height=2 * y, count=(16, 16))
    elif shape.kind == "cylinder":
        mesh = trimesh.creation.cylinder(radius=x, height=2 * y, sections=32)
    elif shape.kind == "box":
        mesh = trimesh.creation.box(extents=(2 * x, 2 * y, 2 * z))
    else:
        mesh = trimesh.Trimesh(shape.vertices, shape.faces)
    turn = viser.transforms.SO3(shape.wxyz)
    mesh.apply_transform(viser.transforms.SE3.from_rotation_and_translation(turn, shape.position).as_matrix())
    if shape.kind not in ("sphere", "capsule"):
        mesh.unmerge_vertices()  # edges are drawn as edges
    return mesh


def beam_mesh(beams: Vector) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return the vertices and faces of beams (n, 2, 3): a level strip each."""
    along = beams[:, 1] - beams[:, 0]
    aside = np.stack([-along[:, 1], along[:, 0], np.zeros(len(beams))], axis=1)
    aside *= BEAM_WIDTH / 2 / np.maximum(1e-9, np.linalg.norm(aside, axis=1, keepdims=True))
    vertices = np.concatenate([beams - aside[:, np.newaxis], beams + aside[:, np.newaxis]], axis=1)
    faces = 4 * np.arange(len(beams))[:, np.newaxis, np.newaxis] + [(0, 2, 1), (1, 2, 3)]
    return vertices.reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3).astype(np.uint32)


def floor_lines(extent: float) -> bytes:
    """Return a grid on the floor as glTF, about four times as wide as `extent` [m]: plain lines, a pixel wide.

    viser's own grid, and any floor that is filled, takes a third of a frame without a graphics card. Each line is cut
    at crossings: software rendering drops a line that ends behind the camera.
    """
    cells = 4 * int(4 * extent / (4 * CELL_M))  # whole metres to both sides
    at = CELL_M * (np.arange(cells + 1) - cells / 2)
    across, along = np.meshgrid(at, at)
    corners = np.stack([along, across, np.zeros_like(along)], axis=2)
    rows = np.stack([corners[:, :-1], corners[:, 1:]], axis=2).reshape(-1, 3)
    ends = np.vstack([rows, rows[:, [1, 0, 2]]])
    untyped: Any = trimesh
    lines = [untyped.path.entities.Line(pair) for pair in np.arange(len(ends)).reshape(-1, 2)]
    path = untyped.path.Path3D(lines, ends, colors=np.tile((*LINE_COLOUR, 255), (len(lines), 1)), process=False)
    return bytes(untyped.Scene(path).export(file_type="glb"))
