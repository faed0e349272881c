"""The scene in the browser: a MuJoCo model's shapes as viser nodes, handles, laser beams and the robot's path."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import trimesh
import viser

from rlservo.deploy.cockpit.meshes import beam_mesh, floor_lines, shape_mesh
from rlservo.deploy.cockpit.message_checks import point_of
from rlservo.deploy.cockpit.stage import Scene, Stage, Vector
from rlservo.envs.shapes import Poses, Shape, body_poses, moving_bodies, visible_shapes

SHOWN_BEAMS = 128  # of a thousand
PATH_POINTS = 600
PATH_SPACING, PLANAR_PATH_SPACING = 0.008, 0.02  # [m]
PATH_WIDTH = 0.6  # of the spacing: a point is drawn about twice as wide as its size
PUT_ELSEWHERE = 0.5  # [m] in a frame: no path
BEAM_COLOUR, PATH_COLOUR, GHOST_COLOUR = (220, 60, 50), (40, 120, 220), (60, 130, 240)
GHOST_OPACITY = 0.35
TARGET_LIFT, ROBOT_LIFT, OBSTACLE_LIFT = 0.1, 0.45, 0.55  # [m], of handles on the floor: above what they move
HELD_S = 1.0  # after the last movement
HANDLE_SIZE, PLANAR_HANDLE_SIZE = 0.3, 1.0  # [m]

LEGEND = "<div style='font-size:0.75em;padding:0 1em 0.5em'>{}; axes: x red, y green, z blue</div>".format(
    ", ".join(
        f"<span style='color:rgb{colour}'>&#9632;</span>&nbsp;{name}"
        for colour, name in ((PATH_COLOUR, "robot's path"), (GHOST_COLOUR, "ghost"), (BEAM_COLOUR, "laser beams"))
    )
)
AXES_LENGTH, AXES_RADIUS = 0.25, 0.006  # [m], at an arm's base, else the world's origin

Move = Callable[[Vector], None]
MoveOne = Callable[[int, Vector], None]


class Scenery:
    """All drawn objects of one robot; `remove` removes them."""

    def __init__(
        self,
        server: viser.ViserServer,
        stage: Stage,
        *,
        on_target: Move | None = None,
        on_robot: Move | None = None,
        on_obstacle: MoveOne | None = None,
    ) -> None:
        """Draw a stage; `on_...` (of obstacles with an index) are called with a position while a handle is dragged."""
        self._server = server
        env = stage.env
        self._robot = _Bodies(server, "/robot", stage, ghost=False)
        self._ghost = _Bodies(server, "/ghost", stage, ghost=True)
        # Neither is made of viser's lines: without a graphics card each segment costs as much as a whole mesh.
        vertices, faces = beam_mesh(np.zeros((1, 2, 3)))
        self._beams = server.scene.add_mesh_simple(
            "/beams", vertices, faces, color=BEAM_COLOUR, side="double", visible=False
        )
        self._spacing = PLANAR_PATH_SPACING if env.IS_PLANAR else PATH_SPACING
        self._path = server.scene.add_point_cloud(
            "/path",
            np.zeros((1, 3)),
            PATH_COLOUR,
            point_size=PATH_WIDTH * self._spacing,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )
        self._points = np.zeros((0, 3))
        self._drawn_beams: Vector | None = None
        self._axes = server.scene.add_frame(
            "/axes", axes_length=AXES_LENGTH, axes_radius=AXES_RADIUS, position=getattr(env, "BASE", np.zeros(3))
        )
        self._target, self._start = None, None
        if on_target is not None and env.target_position() is not None:
            self._target = _Handle(server, "/target", TARGET_LIFT, env.IS_PLANAR, on_target)
        if on_robot is not None:
            self._start = _Handle(server, "/start", ROBOT_LIFT, env.IS_PLANAR, on_robot)
        self._obstacles: list[_Handle] = []
        if on_obstacle is not None:
            self._obstacles = [
                _Handle(server, f"/obstacle_{index}", OBSTACLE_LIFT, env.IS_PLANAR, partial(on_obstacle, index))
                for index in range(len(env.obstacle_positions()))
            ]
        self.offer_start(False)
        floor = floor_lines(float(env.model.stat.extent))
        self._floor = server.scene.add_glb("/floor", floor, cast_shadow=False, receive_shadow=False)

    def offer_start(self, offered: bool) -> None:
        """Show the robot's handle or the target's: once the robot has arrived, both would be in one place."""
        if self._start is not None:
            self._start.show(offered)
        if self._target is not None:
            self._target.show(not offered)

    def draw(self, before: Scene, after: Scene, share: float, ghost: tuple[Scene, Scene] | None) -> None:
        """Draw the moment a share of the way from one control cycle to the next."""
        robot = before.robot + share * (after.robot - before.robot)
        with self._server.atomic():
            self._robot.place(before.poses.towards(after.poses, share))
            self._ghost.show(ghost is not None)
            if ghost is not None:
                self._ghost.place(ghost[0].poses.towards(ghost[1].poses, share))
            if self._start is not None:
                self._start.follow(robot)
            if self._target is not None and after.target is not None:
                self._target.follow(after.target)
            for handle, position in zip(self._obstacles, after.obstacles, strict=False):
                handle.follow(position)
            self._draw_beams((before if share < 0.5 else after).beams)
            self._draw_path(robot)

    def remove(self) -> None:
        """Remove everything."""
        parts = (self._robot, self._ghost, self._target, self._start, *self._obstacles)
        for part in (*parts, self._beams, self._path, self._axes, self._floor):
            if part is not None:
                part.remove()

    def _draw_beams(self, beams: Vector) -> None:
        if self._drawn_beams is beams:
            return
        self._drawn_beams = beams
        shown = beams[:: max(1, len(beams) // SHOWN_BEAMS)]
        self._beams.visible = len(shown) > 0
        if len(shown):
            vertices, faces = beam_mesh(shown)
            if len(faces) != len(self._beams.faces):
                self._beams.faces = faces
            self._beams.vertices = vertices

    def _draw_path(self, position: Vector) -> None:
        last = self._points[-1] if len(self._points) else position
        distance = float(np.linalg.norm(position - last))
        if distance > PUT_ELSEWHERE or not len(self._points):
            self._points = position[np.newaxis]
        elif distance < self._spacing:
            return
        else:
            shares = np.arange(1, int(distance / self._spacing) + 1) * self._spacing / distance
            self._points = np.vstack([self._points, last + np.outer(shares, position - last)])[-PATH_POINTS:]
        self._path.points = self._points.astype(np.float32)


class _Bodies:
    """The shapes of a model, each body's under a frame of its own. A ghost is translucent, and the robot alone."""

    def __init__(self, server: viser.ViserServer, prefix: str, stage: Stage, *, ghost: bool) -> None:
        model, data = stage.env.model, stage.env.data
        moving = moving_bodies(model)
        fixed = body_poses(data, list(range(model.nbody)))
        self._root = server.scene.add_frame(prefix, show_axes=False, visible=not ghost)
        self._frames: dict[int, viser.FrameHandle] = {}
        for body, shapes in _by_body(visible_shapes(model)).items():
            is_robot = model.body_mocapid[body] < 0 and body in moving
            if ghost and not is_robot:
                continue
            frame = server.scene.add_frame(
                f"{prefix}/{body}", show_axes=False, position=fixed.positions[body], wxyz=fixed.wxyz[body]
            )
            if body in moving:
                self._frames[moving.index(body)] = frame
            for index, (rgba, alike) in enumerate(_by_colour(shapes).items()):
                mesh = trimesh.util.concatenate([shape_mesh(shape) for shape in alike])
                red, green, blue, alpha = rgba
                colour = GHOST_COLOUR if ghost else (int(255 * red), int(255 * green), int(255 * blue))
                opacity = GHOST_OPACITY if ghost else alpha if alpha < 1.0 else None
                server.scene.add_mesh_simple(
                    f"{prefix}/{body}/{index}", mesh.vertices, mesh.faces, color=colour, opacity=opacity
                )
        self._placed: Poses | None = None

    def place(self, poses: Poses) -> None:
        for row, frame in self._frames.items():
            placed = self._placed
            if placed is None or not np.array_equal(placed.positions[row], poses.positions[row]):
                frame.position = poses.positions[row]
            if placed is None or not np.array_equal(placed.wxyz[row], poses.wxyz[row]):
                frame.wxyz = poses.wxyz[row]
        self._placed = poses

    def show(self, visible: bool) -> None:
        if self._root.visible != visible:
            self._root.visible = visible

    def remove(self) -> None:
        self._root.remove()


class _Handle:
    """A handle to drag with the mouse or a finger; it stays under that finger."""

    def __init__(self, server: viser.ViserServer, name: str, lift: float, is_planar: bool, on_move: Move) -> None:
        self._control = server.scene.add_transform_controls(
            name,
            scale=PLANAR_HANDLE_SIZE if is_planar else HANDLE_SIZE,
            active_axes=(True, True, not is_planar),
            disable_rotations=True,
            depth_test=False,
        )
        self._lift = np.array([0.0, 0.0, lift if is_planar else 0.0])
        self._held_until = 0.0  # a browser that goes away while it drags never lets go
        self._control.on_update(lambda event: self._moved(event, on_move))

    def show(self, visible: bool) -> None:
        self._control.visible = visible

    def follow(self, position: Vector) -> None:
        at = position + self._lift
        where = point_of(self._control.position)
        is_elsewhere = self._control.visible and (where is None or not np.allclose(where, at, atol=1e-6))
        if is_elsewhere and time.monotonic() > self._held_until:
            self._control.position = at

    def remove(self) -> None:
        self._control.remove()

    def _moved(self, event: viser.TransformControlsEvent, on_move: Move) -> None:
        self._held_until = 0.0 if event.phase == "end" else time.monotonic() + HELD_S
        position = point_of(event.target.position)
        if position is not None:
            on_move(position - self._lift)


def _by_body(shapes: list[Shape]) -> dict[int, list[Shape]]:
    found: dict[int, list[Shape]] = {}
    for shape in shapes:
        if shape.kind != "plane":  # the floor is a grid
            found.setdefault(shape.body, []).append(shape)
    return found


def _by_colour(shapes: list[Shape]) -> dict[tuple[float, float, float, float], list[Shape]]:
    found: dict[tuple[float, float, float, float], list[Shape]] = {}
    for shape in shapes:
        found.setdefault(shape.rgba, []).append(shape)
    return found
