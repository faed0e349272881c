"""Isaac Lab's reach policy for a real UR10e, the whole way: a run of rsl_rl, its bundle, an arm over RTDE and ROS 2."""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from outside_arm import flange, outside_arm
from rlservo.drive.control_loop import rollout
from rlservo.errors import UsageError
from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.policy.policy import Policy
from ros import Ros

pytest.importorskip("rtde_control")
pytest.importorskip("rsl_rl")
torch = pytest.importorskip("torch")

RUN = Path(__file__).resolve().parents[2] / "examples" / "checkpoints" / "ur10e_isaac_deploy_reach"
SIM, REAL = "rlservo/IsaacDeployReachURSim-v0", "rlservo/IsaacDeployReachURRob-v0"
POSES = max(3, int(os.environ.get("RLSERVO_ROS_TARGETS", "0")))  # as for the drives through ROS 2
SPEEDS = 0.1 * np.array([2.0944, 2.0944, *[np.pi] * 4])  # [rad/s], half of the driver's, a fifth of the data sheet's
# Slow and smooth: the controller, 500 times a second, calls it a jump where a busy machine holds commands up.
LIMITS = {"watchdog_hz": 1.0, "speed_scale": 0.5, "lookahead_s": 0.2, "blend_s": 0.1}
TOOL_SPEED, ACCELERATION, OVERSHOOT = 0.5, 5.0, 1.3  # [m/s], [rad/s^2]; servoj's own


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a user exports: only the frame is in no file."""
    notices: list[str] = []
    result = export_checkpoint(
        RUN, tmp_path_factory.mktemp("policies"), name="reach", conventions={"frame": "base"}, notify=notices.append
    )
    assert notices == []
    return result.path


class RelativeJointPositionAction:
    """Isaac Lab's action term (isaaclab/envs/mdp/actions/joint_actions.py), over an articulation of six joints."""

    def __init__(self, cfg: dict[str, Any], asset: Any) -> None:
        self.cfg, self._asset = cfg, asset
        names = asset.joint_names
        self._joint_ids = [i for i, name in enumerate(names) if any(re.fullmatch(k, name) for k in cfg["joint_names"])]
        self._scale, self._offset = float(cfg["scale"]), float(cfg["offset"])
        if cfg["use_zero_offset"]:
            self._offset = 0.0
        assert cfg["clip"] is None

    def process_actions(self, actions: Any) -> None:
        self._raw_actions = actions
        self._processed_actions = self._raw_actions * self._scale + self._offset

    def apply_actions(self) -> None:
        current_actions = self._processed_actions + self._asset.data.joint_pos[:, self._joint_ids]
        self._asset.set_joint_position_target(current_actions, joint_ids=self._joint_ids)


def isaac_targets(joint_pos: Any, joint_vel: Any, command: Any) -> Any:
    """Return the joint targets of rsl_rl's inference policy behind Isaac Lab's observation and action managers."""
    from rsl_rl.runners import OnPolicyRunner
    from tensordict import TensorDict

    agent = yaml.safe_load((RUN / "params" / "agent.yaml").read_text())
    env_cfg = yaml.safe_load((RUN / "params" / "env.yaml").read_text())
    terms = {"joint_pos": joint_pos, "joint_vel": joint_vel, "generated_commands": command}
    group = [term for term in env_cfg["observations"]["policy"].values() if isinstance(term, dict)]
    seen = torch.cat([terms[term["func"].rpartition(":")[2]] for term in group], dim=-1)
    obs = TensorDict({"policy": seen}, batch_size=[len(seen)])
    env = SimpleNamespace(num_envs=len(seen), num_actions=6, device="cpu", cfg={}, get_observations=lambda: obs)
    runner = OnPolicyRunner(env, agent, None, "cpu")
    runner.load(str(next(RUN.glob("model_*.pt"))), load_cfg={"actor": True})
    sent: list[Any] = []
    names = yaml.safe_load((RUN / "io_descriptors" / "IO_descriptors.yaml").read_text())["articulations"]["robot"]
    asset = SimpleNamespace(
        joint_names=names["joint_names"], data=SimpleNamespace(joint_pos=joint_pos),
        set_joint_position_target=lambda target, joint_ids: sent.append(target[:, joint_ids]),
    )  # fmt: skip
    term = RelativeJointPositionAction(env_cfg["actions"]["arm_action"], asset)
    with torch.no_grad():
        term.process_actions(runner.get_inference_policy()(obs))
    term.apply_actions()
    return sent[0]


def observations(count: int) -> Any:
    """Draw joints around the start, velocities and poses, with quaternions x, y, z, w: (count, 19)."""
    torch.manual_seed(3)
    start = torch.tensor([np.pi, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0], dtype=torch.float32)
    turn = torch.tensor([0.7, -0.7, 0.0, 0.0]) + 0.3 * torch.randn(count, 4)
    place = torch.tensor([0.9, -0.2, 0.2]) + 0.2 * torch.randn(count, 3)
    parts = (start + 0.7 * torch.randn(count, 6), 0.4 * torch.randn(count, 6), place)
    return torch.cat([*parts, turn / turn.norm(dim=-1, keepdim=True)], dim=-1)


def test_bundle_sends_the_targets_of_rsl_rls_policy_and_isaac_labs_action_term(bundle: Path) -> None:
    obs = observations(200)
    wanted = isaac_targets(obs[:, :6], obs[:, 6:12], obs[:, 12:]).numpy()
    with Policy.load(bundle) as policy:
        actions = np.stack([policy.act(row) for row in obs.numpy()])
        elements = policy.contract.action_space.elements
        assert policy.contract.control_rate_hz == pytest.approx(60.0)
    assert np.abs(wanted - obs[:, :6].numpy()).max() > 0.05
    np.testing.assert_allclose(actions, wanted, rtol=1e-6, atol=2e-6)
    assert {(one.quantity, one.unit, one.scale, one.offset) for one in elements} == {
        ("joint position", "rad", 1.0, 0.0)
    }


def test_leapp_export_of_the_same_policy_sends_the_same_targets(bundle: Path, tmp_path: Path) -> None:
    """As Isaac Lab annotates it: joint states and command in, the joint position target out."""
    leapp = pytest.importorskip("leapp")
    weights = torch.load(next(RUN.glob("model_*.pt")), weights_only=True)["actor_state_dict"]
    sizes = [19, 256, 128, 64, 6]
    layers: list[Any] = []
    for number, (into, out) in enumerate(itertools.pairwise(sizes)):
        layers += [torch.nn.Linear(into, out), torch.nn.ELU()]
        layers[-2].load_state_dict({k: weights[f"mlp.{2 * number}.{k}"] for k in ("weight", "bias")})
    net = torch.nn.Sequential(*layers[:-1]).eval().requires_grad_(False)
    mean, std = weights["obs_normalizer._mean"], weights["obs_normalizer._std"] + 1e-2
    joints = [f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]
    parts, kinds = ["x", "y", "z", "qx", "qy", "qz", "qw"], leapp.InputKindEnum
    leapp.start("reach", save_path=str(tmp_path / "leapp"), max_cached_io=2)
    for rows in observations(2).split(1):
        position, velocity, command = leapp.annotate.input_tensors("act", [
            leapp.TensorSemantics(name="robot_joint_pos", ref=rows[:, :6], kind=kinds.JOINT_POSITION,
                                  element_names=[joints], extra={"units": "rad"}),
            leapp.TensorSemantics(name="robot_joint_vel", ref=rows[:, 6:12], kind=kinds.JOINT_VELOCITY,
                                  element_names=[joints], extra={"units": "rad/s"}),
            leapp.TensorSemantics(name="ee_pose", ref=rows[:, 12:], kind=kinds.COMMAND_POSE, element_names=[parts],
                                  extra={"frame": "base"}),
        ])  # fmt: skip
        action = net((torch.cat([position, velocity, command], dim=-1) - mean) / std)
        target = leapp.TensorSemantics(name="arm_action", ref=action * 0.0625 + position, element_names=[joints],
                                       kind=leapp.OutputKindEnum.JOINT_POSITION, extra={"units": "rad"})  # fmt: skip
        leapp.annotate.output_tensors("act", [target], export_with="jit-trace")
    leapp.stop()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch calls its tracer deprecated
        leapp.compile_graph(visualize=False, graph_configs=leapp.GraphConfigs(frequency=60.0))
    notices: list[str] = []
    exported = export_checkpoint(tmp_path / "leapp" / "reach", tmp_path / "out", notify=notices.append)
    assert notices == []
    rows = observations(50).numpy()
    with Policy.load(bundle) as ours, Policy.load(exported.path) as theirs:
        wanted = np.stack([ours.act(row) for row in rows])
        keys = {"robot_joint_pos": slice(0, 6), "robot_joint_vel": slice(6, 12), "ee_pose": slice(12, 19)}
        found = np.stack([theirs.act({key: row[part] for key, part in keys.items()}) for row in rows])
        elements = theirs.contract.action_space.elements
    np.testing.assert_allclose(found, wanted, atol=1e-5, rtol=0)
    assert {(one.quantity, one.unit) for one in elements} == {("joint position", "rad")}


def w_first(env: dict[str, Any], _: dict[str, Any]) -> None:
    """Isaac Lab 2 has the solver's settings in sim.physx."""
    env["sim"] = {"dt": env["sim"]["dt"], "physx": {}}
    env["scene"]["robot"]["init_state"]["rot"] = [1.0, 0.0, 0.0, 0.0]


def degrees(env: dict[str, Any], _: dict[str, Any]) -> None:
    env["observations"]["policy"]["joint_pos"]["scale"] = 180.0 / np.pi


def other_joints(_: dict[str, Any], described: dict[str, Any]) -> None:
    swapped = described["articulations"]["robot"]["joint_names"]
    swapped[0], swapped[1] = swapped[1], swapped[0]
    for part in (*described["actions"], *described["observations"]["policy"][:2]):
        part["joint_names"] = swapped


def relative(env: dict[str, Any], _: dict[str, Any]) -> None:
    """A position that is clipped is none, so that the steps cannot be added to it."""
    env["observations"]["policy"]["joint_pos"]["clip"] = [-1.0, 1.0]


def velocity(env: dict[str, Any], described: dict[str, Any]) -> None:
    kind = env["actions"]["arm_action"]["class_type"] = "isaaclab.envs.mdp.actions.joint_actions:JointVelocityAction"
    described["actions"][0]["full_path"] = kind.replace(":", ".")


def same(_: dict[str, Any], __: dict[str, Any]) -> None:
    pass


SWAPS: list[tuple[Callable[[dict[str, Any], dict[str, Any]], None], str, str]] = [
    (w_first, "base", "elements 15 to 18 are a quaternion x, y, z, w there, but the policy has w, x, y, z"),
    (degrees, "base", r"element 0 \(base_position\) has scale 1 there, but the policy has 0\.01745"),
    (same, "base_link", r"element 12 \(pose_command_x\) is in frame base there, but the policy has base_link"),
    (
        other_joints,
        "base",
        r"element 0 \(base_position\) is of shoulder_pan_joint there, but the policy has shoulder_",
    ),
    (relative, "base", r"action element 0 .* is a joint position there, but the policy has relative joint position"),
    (velocity, "base", r"action element 0 .* is a joint position there, but the policy has joint velocity"),
]


@pytest.mark.parametrize(("swap", "frame", "words"), SWAPS, ids=lambda one: getattr(one, "__name__", ""))
def test_swapped_convention_is_refused(
    swap: Callable[[dict[str, Any], dict[str, Any]], None], frame: str, words: str, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(RUN, run)
    files = run / "params" / "env.yaml", run / "io_descriptors" / "IO_descriptors.yaml"
    env, described = (yaml.safe_load(file.read_text()) for file in files)
    swap(env, described)
    for file, settings in zip(files, (env, described), strict=True):
        file.write_text(yaml.safe_dump(settings, sort_keys=False))
    result = export_checkpoint(run, tmp_path, name="reach", conventions={"frame": frame}, notify=lambda _: None)
    with Policy.load(result.path) as policy, pytest.raises(UsageError, match=words):
        rollout(policy, SIM, episodes=1)


def test_pose_without_a_frame_is_no_real_arms(tmp_path: Path) -> None:
    notices: list[str] = []
    result = export_checkpoint(RUN, tmp_path, name="reach", notify=notices.append)
    assert "no file says the frame of pose_command_x ... (--convention frame=NAME)" in notices[-1]
    with outside_arm("ur10e", 125.0) as arm, Policy.load(result.path) as policy:
        with pytest.raises(UsageError, match=r"the frame of element 12 .*; the robot's is base: .*--convention frame="):
            rollout(policy, REAL, episodes=1, env_kwargs={"robot": f"rtde://{arm.host}", "confirm": False})
        assert arm.recorder.motion().fastest() < 1e-9


def test_policy_reaches_its_poses_over_rtde_within_the_arms_limits(bundle: Path) -> None:
    with outside_arm("ur10e", 125.0) as arm, Policy.load(bundle) as policy:
        robot = {"robot": f"rtde://{arm.host}", "confirm": False, "limits": LIMITS, "rs_state_to_info": False}
        report = rollout(policy, REAL, episodes=POSES, seed=11, env_kwargs=robot, unproven=True)
        motion = arm.recorder.motion()
    outcomes = [row.final_status for row in report.episodes]
    assert outcomes.count("success") >= POSES - POSES // 20, outcomes
    assert [row.final_status for row in report.episodes].count("collision") == 0
    assert (np.abs(motion.setpoint_velocities).max(axis=0) <= OVERSHOOT * SPEEDS).all()
    assert motion.hardest() <= OVERSHOOT * ACCELERATION
    places = np.array([flange(joints)[:3, 3] for joints in motion.positions[::8]])
    assert places[:, 2].min() > 0.0
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(motion.time_s[::8])
    assert 0.1 < speeds.max() <= OVERSHOOT * TOOL_SPEED


def test_policy_reaches_its_poses_through_topics_with_commands_within_the_arms_limits(bundle: Path, ros: Ros) -> None:
    sim = ros.rlservo("ros2-sim", "ur10e")
    sim.wait_for("ur10e on ROS 2")
    topic = "/forward_position_controller/commands"
    ros.ask("subscribe", topic=topic, kind="std_msgs/msg/Float64MultiArray")
    driving = ros.rlservo(
        "rollout", REAL, "--bundle", bundle, "--episodes", POSES, "--seed", 12, "--env-arg", "robot=ros2:",
        "--env-arg", f"limits={json.dumps(LIMITS)}", "--unproven", "--yes", "--json",
    )  # fmt: skip
    commands: list[tuple[float, dict[str, Any]]] = []
    while driving.process.poll() is None:
        driving.read(1.0)
        commands += ros.ask("since", topic=topic, time_s=np.nextafter(commands[-1][0], np.inf) if commands else 0.0)
    assert driving.end(0) == 0, "\n".join(driving.lines[-30:])
    text = "\n".join(driving.lines)
    outcomes = [row["final_status"] for row in json.loads(text[text.index("{\n") :])["episodes"]]
    assert outcomes.count("success") >= POSES - POSES // 20 and "collision" not in outcomes, outcomes
    # The commands, not the arm: a simulated driver that the machine has held up takes several at once, and hurries.
    velocities = 125.0 * np.diff([one["data"] for _, one in commands], axis=0)
    is_within = (np.abs(velocities) <= 1.001 * SPEEDS).all(axis=1)
    assert len(velocities) > 500 * POSES and np.abs(velocities).max() > 0.9 * SPEEDS.max()
    assert is_within.mean() > 0.99  # this node may miss one, and the next looks like two


def test_ros_node_says_what_drives_a_policy_whose_targets_have_orientations(bundle: Path, ros: Ros) -> None:
    node = ros.rlservo("ros2", "--bundle", bundle, "--robot", "ros2:", "--unproven")
    assert node.end(0) == 2
    assert f"does not take: drive it by rlservo rollout {REAL} --env-arg robot=ros2:" in node.lines[-1]
