"""Reference for an environment's action terms: Isaac Lab's and mjlab's `process_actions`, term by term in torch.

The parity gate compares a graph with it, so it shares nothing with isaac_env.py: it reads the files again, as text,
finds joints by their index in the robot, and computes as JointAction does (isaaclab/envs/mdp/actions/joint_actions.py).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import torch
import yaml
from torch import Tensor

from rlservo.errors import CheckpointError, first_line

Process: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""Takes a policy's actions `[batch, n]` and observations, and returns what the robot is sent."""


WIDTHS = {"base_pos_z": 1, "root_quat_w": 4} | dict.fromkeys(
    ("base_lin_vel", "base_ang_vel", "projected_gravity", "root_pos_w", "root_lin_vel_w", "root_ang_vel_w"), 3
)
"""Of observation terms that are neither of joints, commands nor the last action."""


class _Text(yaml.BaseLoader):
    """Reads every value as text, and a Python class as its path."""

    def construct_scalar(self, node: Any) -> Any:
        path = node.tag.partition("python/name:")[2]
        return path or super().construct_scalar(node)


def process_actions(
    env_file: Path | None, joint_order: Sequence[str], clip_actions: float | None, positions_in: Sequence[str]
) -> Process:
    """Return the environment's processing; without `env_file` only the wrapper's clip of an action.

    With `positions_in`, the groups that an observation concatenates, RelativeJointPositionAction's `apply_actions` adds
    the joint positions in it. Raises CheckpointError if the file does not describe it.
    """
    try:
        terms = [] if env_file is None else list(_terms(env_file, joint_order))
        if env_file is not None and positions_in:
            for term in terms:
                term.find_positions(_read(env_file), positions_in, sum(len(one.joints) for one in terms))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{env_file}: its action terms cannot be computed: {first_line(error)}") from error

    def process(actions: Tensor, obs: Tensor) -> Tensor:
        if clip_actions is not None:
            actions = torch.clamp(actions, -clip_actions, clip_actions)
        if not terms:
            return actions
        parts = torch.split(actions, [len(term.joints) for term in terms], dim=-1)
        return torch.cat([term.process(part) + term.present(obs) for term, part in zip(terms, parts, strict=True)], -1)

    return process


def _terms(env_file: Path, joint_order: Sequence[str]) -> Iterator[_JointAction]:
    env = _read(env_file)
    robots = _read(env_file.parents[1] / "io_descriptors" / "IO_descriptors.yaml").get("articulations", {})
    moved = [
        term.get("asset_name", term.get("entity_name", "robot")) for term in env["actions"].values() if term != "null"
    ]
    ordered = moved[0] if len(set(moved)) == 1 else "robot"  # the one whose order the user gives
    for term in env["actions"].values():
        if term != "null":
            asset = term.get("asset_name", term.get("entity_name", "robot"))
            joints = robots.get(asset, {}).get("joint_names", joint_order if asset == ordered else [])
            scene = env.get("scene", {})
            entity = scene.get(asset, scene.get("entities", {}).get(asset, {}))
            yield _JointAction(term, joints, entity.get("init_state", {}))


class _JointAction:
    def __init__(self, term: Mapping[str, Any], robot: Sequence[str], state: Mapping[str, Any]) -> None:
        listed = term.get("joint_names", term.get("actuator_names"))
        listed = [listed] if isinstance(listed, str) else listed
        robot = robot or listed
        self._robot, self._state = robot, state
        self._is_relative = "RelativeJointPosition" in term["class_type"]
        self._columns: list[int] = []
        indices = [index for pattern in listed for index in _find(pattern, robot)]
        if term.get("preserve_order") != "true":
            indices.sort()
        self.joints = [robot[index] for index in indices]
        self._scale = self._tensor(term.get("scale", "1"), 1.0)
        self._offset = self._tensor(term.get("offset", "0"), 0.0)
        if term.get("use_zero_offset") == "true":  # RelativeJointPositionAction
            self._offset = torch.zeros(len(self.joints))
        kind = term["class_type"]
        default = "joint_pos" if "JointPosition" in kind else "joint_vel" if "JointVelocity" in kind else None
        if default and term.get("use_default_offset") == "true":
            given = state[default]
            if kind.startswith("mjlab"):  # the first pattern that matches a name's beginning
                self._offset = torch.zeros(len(self.joints))
                for pattern in reversed(given):
                    begins = [number for number, joint in enumerate(self.joints) if re.match(pattern, joint)]
                    self._offset[begins] = float(given[pattern])
            else:
                self._offset = self._tensor(given, 0.0)
        self._clip = term.get("clip", "null")

    def process(self, raw: Tensor) -> Tensor:
        processed = raw * self._scale + self._offset
        if self._clip == "null":
            return processed
        sides = torch.tensor([[-math.inf, math.inf]]).repeat(len(self.joints), 1)
        for pattern, side in self._clip.items():
            sides[list(_find(pattern, self.joints))] = torch.tensor([_number(end) for end in side])
        return torch.clamp(processed, min=sides[:, 0], max=sides[:, 1])

    def find_positions(self, env: Mapping[str, Any], groups: Sequence[str], width: int) -> None:
        """Find the columns of the joints' positions, given the width of all actions."""
        at = 0
        for group in (env["observations"][name] for name in groups if self._is_relative):
            for term in group.get("terms", group).values():
                if self._columns or not isinstance(term, Mapping) or "func" not in term:
                    continue
                function, params = re.split("[.:]", term["func"])[-1], term.get("params") or {}
                names = params["asset_cfg"].get("joint_names", "null") if "asset_cfg" in params else "null"
                names = [names] if isinstance(names, str) else names
                joints = [one for one in self._robot if names == ["null"] or any(re.fullmatch(n, one) for n in names)]
                if function in ("joint_pos", "joint_pos_rel"):
                    self._columns = [at + joints.index(joint) for joint in self.joints]
                    self._factor = 1.0 / _number(term["scale"]) if term.get("scale", "null") != "null" else 1.0
                    self._default = self._tensor(self._state["joint_pos"] if function == "joint_pos_rel" else "0", 0.0)
                elif function == "generated_commands":
                    at += 7 if "Pose" in env["commands"][params["command_name"]]["class_type"] else 3
                else:
                    at += WIDTHS.get(function) or (len(joints) if function.startswith("joint_") else width)

    def present(self, obs: Tensor) -> Tensor | float:
        """Return the joints' positions in observations; 0 if the action is not relative to them."""
        return obs[:, self._columns] * self._factor + self._default if self._columns else 0.0

    def _tensor(self, given: Any, missing: float) -> Tensor:
        if isinstance(given, str):
            return torch.full((len(self.joints),), _number(given))
        values = torch.full((len(self.joints),), missing)
        for pattern, value in given.items():
            if indices := list(_find(pattern, self.joints)):
                values[indices] = _number(value)
        return values


def _find(pattern: str, names: Sequence[str]) -> Iterator[int]:
    whole = re.compile(rf"(?:{pattern})\Z")
    return (index for index, name in enumerate(names) if whole.match(name))


def _number(text: str) -> float:
    return float({"true": "1", "false": "0"}.get(text, text.replace(".inf", "inf")))


def _read(file: Path) -> dict[str, Any]:
    read = yaml.load(file.read_text("utf-8"), _Text) if file.is_file() else {}
    return read if isinstance(read, dict) else {}
