"""Policies to mutate: of every source, trained or made by the tests' own helpers."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from mutating.gate import MutatedPolicy

from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.export.sources.registry import find_source

ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests"
SHIPPED = ROOT / "examples" / "checkpoints"
ZOOS = {
    "train_zoo.py": ("pendulum", "double", "grid", "clipped", "dqn", "sac"),
    "train_wide_zoo.py": (
        "lstm_box", "stacked_vectors", "stacked", "act_nested", "previous", "obs_integers_filtered_first",
    ),
    "train_old_zoo.py": ("pendulum", "filtered_beams", "mixed", "continuous_lstm"),
}  # fmt: skip
"""Checkpoints that RLlib trained for the tests, by the script that trains them."""


def policies(folder: Path) -> dict[str, Callable[[], MutatedPolicy]]:
    """Return functions that make the policies, by name; files that they need are written into `folder`."""
    made: dict[str, Callable[[], MutatedPolicy]] = {}
    for script, names in ZOOS.items():
        for name in names:
            label = f"rllib {'old ' if 'old' in script else ''}{name}"
            made[label] = partial(_of_zoo, label, script, name)
    for name in ("ur5_positioning", "mir100_sparse_fixes"):
        made[f"rllib {name} (shipped)"] = partial(_from_path, f"rllib {name} (shipped)", SHIPPED / name)
    for source in (sb3_ppo, sb3_far, sb3_frames, sb3_recurrent, sb3_tqc, rsl_rl, rsl_rl_gru, skrl, leapp, torch):
        made[source.__name__.replace("_", " ")] = partial(source, folder)
    return made


def _from_path(name: str, path: Path, **options: Any) -> MutatedPolicy:
    def export(out: Path) -> Any:
        return export_checkpoint(path, out, name="policy", notify=lambda _: None, **options)

    return MutatedPolicy(name, type(find_source(path)), export)


def _helper(name: str) -> Any:
    """Return a module of the tests."""
    for folder in (TESTS, TESTS / "export" / "sources"):
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
    return import_module(name)


def _of_zoo(label: str, script: str, name: str) -> MutatedPolicy:
    checkpoints = _helper("checkpoints")
    return _from_path(label, checkpoints.trained(script) / name, app_dir=checkpoints.APP)


def sb3_ppo(folder: Path) -> MutatedPolicy:
    """PPO behind VecNormalize."""
    tests = _helper("test_sb3")
    vec, env = tests.normalized(tests.OPEN, tests.BOX)
    path = folder / "sb3_ppo" / "model"
    tests.make(tests.sb3.PPO, "MlpPolicy", tests.OPEN, tests.BOX, env).save(path)
    vec.save(path.with_name("vecnormalize.pkl"))
    return _from_path("sb3 ppo", path.with_suffix(".zip"))


def sb3_far(folder: Path) -> MutatedPolicy:
    """The same with double-precision observations far from 0, such as a clock's or a position on the earth."""
    tests = _helper("test_sb3")
    vec, env = tests.normalized(tests.OPEN, tests.BOX)
    vec.obs_rms.mean += 1e8
    path = folder / "sb3_far" / "model"
    tests.make(tests.sb3.PPO, "MlpPolicy", tests.OPEN, tests.BOX, env).save(path)
    vec.save(path.with_name("vecnormalize.pkl"))
    return _from_path("sb3 far", path.with_suffix(".zip"))


def sb3_frames(folder: Path) -> MutatedPolicy:
    """PPO behind VecNormalize and VecFrameStack."""
    tests = _helper("test_sb3")
    vec, env = tests.normalized(tests.VECTOR, tests.BOX, 3)
    path = folder / "sb3_frames" / "model"
    tests.make(tests.sb3.PPO, "MlpPolicy", tests.VECTOR, tests.BOX, env).save(path)
    vec.save(path.with_name("vecnormalize.pkl"))
    return _from_path("sb3 frames", path.with_suffix(".zip"), frame_stack=3)


def sb3_recurrent(folder: Path) -> MutatedPolicy:
    """PPO with an LSTM."""
    tests = _helper("test_sb3")
    settings = {"policy_kwargs": {"lstm_hidden_size": 5, "n_lstm_layers": 2, **tests.SMALL}}
    path = folder / "sb3_recurrent" / "model"
    tests.make(tests.contrib.RecurrentPPO, "MlpLstmPolicy", tests.VECTOR, tests.BOX, **settings).save(path)
    return _from_path("sb3 recurrent", path.with_suffix(".zip"))


def sb3_tqc(folder: Path) -> MutatedPolicy:
    """TQC, whose action is squashed and unscaled."""
    tests = _helper("test_sb3")
    path = folder / "sb3_tqc" / "model"
    tests.make(tests.contrib.TQC, "MlpPolicy", tests.VECTOR, tests.BOX).save(path)
    return _from_path("sb3 tqc", path.with_suffix(".zip"))


def rsl_rl(folder: Path, **actor: Any) -> MutatedPolicy:
    """Isaac Lab's run: statistics, scale and default offsets."""
    tests = _helper("test_rsl_rl")
    run = folder / f"rsl_rl{'_'.join(['', *actor])}" / "run"
    tests.train(run, {**tests.settings(**actor), "clip_actions": 2.0}, tests.environment({}))
    return _from_path("rsl rl", run, joint_order=tests.ROBOT)


def rsl_rl_gru(folder: Path) -> MutatedPolicy:
    """The same with two layers of gated units."""
    memory = {"class_name": "RNNModel", "rnn_type": "gru", "rnn_hidden_dim": 4, "rnn_num_layers": 2}
    return rsl_rl(folder, **memory)


def skrl(folder: Path) -> MutatedPolicy:
    """PPO with a running scaler."""
    from gymnasium import spaces

    tests = _helper("test_skrl")
    run = folder / "skrl" / "run"
    tests.train(run, tests.config(), spaces.Box(-1, 1, (2,), np.float32))
    return _from_path("skrl", run)


def leapp(folder: Path) -> MutatedPolicy:
    """Two stages and a state: joints, velocities and the last target, then a network."""
    import leapp as library
    import torch as torch_

    torch_.manual_seed(0)
    net = torch_.nn.Sequential(torch_.nn.Linear(7, 8), torch_.nn.ELU(), torch_.nn.Linear(8, 3)).eval()
    net.requires_grad_(False)
    note, semantics, kinds = library.annotate, library.TensorSemantics, library.InputKindEnum
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # LEAPP's own
        library.start("arm", save_path=str(folder), max_cached_io=2)
        for _ in range(2):
            joints, velocities = note.input_tensors("before", [
                semantics(name="q", ref=torch_.randn(1, 2), kind=kinds.JOINT_POSITION),
                semantics(name="dq", ref=torch_.randn(1, 2), kind=kinds.JOINT_VELOCITY),
            ])  # fmt: skip
            last = _only(note.state_tensors("before", {"last": torch_.full((1, 3), 0.25)}))
            seen = torch_.cat([2.0 * joints, velocities, last], dim=-1)
            note.update_state("before", {"last": 0.5 * last + 0.1 * seen[:, :3]})
            seen = _only(note.output_tensors("before", {"seen": seen}, export_with="jit-trace"))
            seen = _only(note.input_tensors("network", {"seen": seen}))
            target = semantics(name="target", ref=0.5 * net(seen), kind=library.OutputKindEnum.JOINT_POSITION)
            note.output_tensors("network", [target], export_with="jit-trace")
        library.stop()
        library.compile_graph(visualize=False, graph_configs=library.GraphConfigs(frequency=20.0))
    return _from_path("leapp", folder / "arm")


def _only(tensors: Any) -> Any:
    return tensors[0] if isinstance(tensors, tuple | list) else tensors


def torch(folder: Path) -> MutatedPolicy:  # noqa: ARG001  # as the others
    """A plain module with a scale and an offset."""
    import torch as torch_
    from gymnasium import spaces

    import rlservo
    from rlservo.export.sources.torch_module import TorchModule

    torch_.manual_seed(1)
    module = torch_.nn.Sequential(torch_.nn.Linear(3, 8), torch_.nn.Tanh(), torch_.nn.Linear(8, 2))
    seen = spaces.Box(-float("inf"), float("inf"), (3,), np.float32)
    arm = spaces.Box(-2.0, 2.0, (2,), np.float32)

    def export(out: Path) -> Any:
        return rlservo.export_policy(
            module, seen, arm, out, name="policy", scale=[3.0, 4.0], offset=0.1, notify=lambda _: None  # type: ignore[arg-type]
        )  # fmt: skip

    return MutatedPolicy("torch", TorchModule, export)
