"""Trained models of Stable-Baselines3 and sb3-contrib against themselves, behind their own VecEnv wrappers.

Each model learns, is saved, loaded by its own class with an environment, and acts in it: what the environment gave is
what the bundle gets, over episodes that end.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from rlservo.errors import CheckpointError, RlservoError, UnsupportedError
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.export.verify_bundle import verify_bundle
from rlservo.policy.policy import Policy

sb3 = pytest.importorskip("stable_baselines3")
contrib = pytest.importorskip("sb3_contrib")
torch = pytest.importorskip("torch")

from stable_baselines3.common.torch_layers import BaseFeaturesExtractor  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize  # noqa: E402

VECTOR = spaces.Box(-2, 3, (4,), np.float32)
MUJOCO = spaces.Box(-np.inf, np.inf, (3,), np.float64)
BOX, ONE = spaces.Box(np.array([-1, -0.5], np.float32), np.array([2, 0.5], np.float32)), spaces.Discrete(3)
STEPS = 160
EPISODE = 9

Wrap = Callable[[Any], Any]


class Recorder(gymnasium.Env[Any, Any]):
    """An environment of random observations, which it keeps, and of episodes of nine steps."""

    def __init__(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self.given: list[tuple[bool, Any]] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._next(begins=True), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        last, space = self.given[-1][1], self.observation_space
        if isinstance(last, dict):
            last, space = last["pose"], space["pose"]  # type: ignore[index]  # a Dict
        bounded = isinstance(space, spaces.Box) and space.is_bounded()
        middle = np.ravel(space.low / 2 + space.high / 2)[0] if bounded else 0.0  # type: ignore[attr-defined]
        wanted = np.sign(np.float64(np.ravel(last)[0]) - middle)
        return self._next(begins=False), float(np.sum(action) * wanted), False, self._steps >= EPISODE, {}

    def _next(self, *, begins: bool) -> Any:
        self._steps = 0 if begins else self._steps + 1
        self.given.append((begins, self.observation_space.sample()))
        return self.given[-1][1]

    def action_masks(self) -> Any:
        return np.ones(self.action_space.n, np.bool_)  # type: ignore[attr-defined]  # asked of a Discrete's only


ON_POLICY = {"n_steps": 40, "batch_size": 20}
OFF_POLICY = {"learning_starts": 40, "train_freq": 4, "batch_size": 16, "buffer_size": 500, "learning_rate": 0.01}
KINDS: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    "PPO": (sb3.PPO, BOX, ON_POLICY),
    "A2C": (sb3.A2C, ONE, {}),
    "SAC": (sb3.SAC, BOX, OFF_POLICY),
    "TD3": (sb3.TD3, BOX, OFF_POLICY),
    "DDPG": (sb3.DDPG, BOX, OFF_POLICY),
    "DQN": (sb3.DQN, ONE, OFF_POLICY),
    "TQC": (contrib.TQC, BOX, OFF_POLICY),
    "TRPO": (contrib.TRPO, BOX, ON_POLICY),
    "QRDQN": (contrib.QRDQN, ONE, OFF_POLICY),
    "CrossQ": (contrib.CrossQ, BOX, OFF_POLICY),
    "ARS": (contrib.ARS, BOX, {"n_delta": 2}),
    "RecurrentPPO": (contrib.RecurrentPPO, BOX, ON_POLICY),
    "MaskablePPO": (contrib.MaskablePPO, ONE, ON_POLICY),
}


def train(name: str, observation: Any, folder: Path, wrap: Wrap = lambda env: env, policy: str = "") -> Path:
    """Train a model behind wrappers, and save it and the statistics of a VecNormalize."""
    kind, action, settings = KINDS[name]
    env = wrap(DummyVecEnv([lambda: Recorder(observation, action)]))
    sizes = {"net_arch": [12], **({"lstm_hidden_size": 6} if name == "RecurrentPPO" else {})}
    policy = policy or ("MlpLstmPolicy" if name == "RecurrentPPO" else "MlpPolicy")
    if name == "ARS":
        sizes = {}
    model = kind(policy, env, policy_kwargs=sizes, device="cpu", seed=2, **settings)
    before = [weights.clone() for weights in model.policy.parameters()]
    model.learn(STEPS)
    after = list(model.policy.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True)), "nothing was learnt"
    model.save(folder / "model")
    if (statistics := model.get_vec_normalize_env()) is not None:
        statistics.save(folder / "vecnormalize.pkl")
    return folder / "model.zip"


def rollout(name: str, observation: Any, model: Path, wrap: Wrap = lambda env: env) -> tuple[list[Any], list[Any]]:
    """Let the loaded model act behind the wrappers; return what its environment gave and its actions."""
    kind, action, _ = KINDS[name]
    recorder = Recorder(observation, action)
    loaded = kind.load(model, env=wrap(DummyVecEnv([lambda: recorder])), device="cpu")
    env = loaded.get_env()
    observation.seed(11)
    recorder.given.clear()
    obs, state, start, actions = env.reset(), None, np.array([True]), []
    for _ in range(4 * EPISODE):
        chosen, state = loaded.predict(obs, state=state, episode_start=start, deterministic=True)
        actions.append(chosen[0])
        obs, _, start, _ = env.step(chosen)
    # A VecEnv resets at an episode's end: the last observation is seen by training only.
    seen = [(begins, obs) for begins, obs in recorder.given]
    last = {number - 1 for number, (begins, _) in enumerate(seen) if begins}
    return [each for number, each in enumerate(seen) if number not in last][: len(actions)], actions


def bundle_actions(name: str, result: ExportResult, seen: list[Any]) -> list[Any]:
    actions = []
    with Policy.load(result.path) as policy:
        for begins, obs in seen:
            if begins:
                policy.reset()
            if name == "MaskablePPO":
                obs = {"observations": obs, "action_mask": np.ones(ONE.n, np.int8)}
            actions.append(policy.act(obs))
    return actions


def check(name: str, result: ExportResult, observation: Any, model: Path, wrap: Wrap = lambda env: env) -> None:
    """Compare a bundle, as it is served, with the model in its environment."""
    seen, wanted = rollout(name, observation, model, wrap)
    found = bundle_actions(name, result, seen)
    np.testing.assert_allclose(np.asarray(found, np.float64), np.asarray(wanted, np.float64), rtol=1e-5, atol=2e-6)
    assert len(np.unique(np.asarray(wanted), axis=0)) > 1, "the policy does not read its observation"


@pytest.mark.parametrize("name", KINDS)
def test_a_trained_model_is_exported_as_it_acts(name: str, tmp_path: Path, notices: list[str]) -> None:
    model = train(name, VECTOR, tmp_path)
    result = export_checkpoint(model, tmp_path / "out", notify=notices.append)
    check(name, result, VECTOR, model)
    assert result.contract.provenance.algorithm == name
    unrecorded = KINDS[name][2] is OFF_POLICY
    (notice,) = [notice for notice in notices if "exported as trained without VecNormalize" in notice]
    assert ("an off-policy model does not record it" in notice) == unrecorded


@pytest.mark.parametrize("name", KINDS)
def test_a_trained_model_behind_vecnormalize_is_exported_as_it_acts(
    name: str, tmp_path: Path, notices: list[str]
) -> None:
    model = train(name, MUJOCO, tmp_path, lambda env: VecNormalize(env, clip_obs=1.5))
    result = export_checkpoint(model, tmp_path / "out", notify=notices.append)
    check(name, result, MUJOCO, model, lambda env: frozen(tmp_path, env))


def frozen(folder: Path, env: Any) -> Any:
    vec = VecNormalize.load(str(folder / "vecnormalize.pkl"), env)
    vec.training = False
    return vec


@pytest.mark.parametrize("name", ["PPO", "ARS", "RecurrentPPO", "SAC", "DQN"])
def test_a_model_that_shows_vecnormalize_is_refused_without_its_statistics(
    name: str, tmp_path: Path, notices: list[str]
) -> None:
    model = train(name, MUJOCO, tmp_path, VecNormalize)
    (tmp_path / "vecnormalize.pkl").rename(tmp_path / "elsewhere.pkl")
    with pytest.raises(CheckpointError, match=r"trained behind VecNormalize.*--vecnormalize none"):
        export_checkpoint(model, tmp_path / "out", notify=notices.append)
    assert not (tmp_path / "out").exists()
    given = export_checkpoint(model, tmp_path / "out", vecnormalize=tmp_path / "elsewhere.pkl", notify=notices.append)
    assert given.contract.baked_in[0].step == "mean_std_filter"


@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_a_model_whose_rewards_alone_were_normalized_is_exported_by_choice(
    name: str, tmp_path: Path, notices: list[str]
) -> None:
    model = train(name, VECTOR, tmp_path, lambda env: VecNormalize(env, norm_obs=False))
    (tmp_path / "vecnormalize.pkl").unlink()
    result = export_checkpoint(model, tmp_path / "out", vecnormalize="none", notify=notices.append)
    check(name, result, VECTOR, model)
    verify_bundle(result.path, model, vecnormalize="none", notify=notices.append)


@pytest.mark.parametrize("name", ["PPO", "ARS", "RecurrentPPO"])
def test_a_model_that_shows_no_vecnormalize_is_refused_beside_anothers_statistics(
    name: str, tmp_path: Path, notices: list[str]
) -> None:
    model = train(name, VECTOR, tmp_path)
    (tmp_path / "other").mkdir()
    train(name, VECTOR, tmp_path / "other", VecNormalize)
    statistics = (tmp_path / "other" / "vecnormalize.pkl").rename(tmp_path / "vecnormalize.pkl")
    with pytest.raises(CheckpointError, match=r"trained without VecNormalize, and vecnormalize\.pkl lies beside it"):
        export_checkpoint(model, tmp_path / "out", notify=notices.append)
    given = export_checkpoint(model, tmp_path / "out", vecnormalize=statistics, notify=notices.append)
    assert given.contract.baked_in[0].step == "mean_std_filter"


def test_statistics_of_another_model_beside_it_are_left_alone_by_choice(tmp_path: Path, notices: list[str]) -> None:
    model = train("SAC", VECTOR, tmp_path)
    (tmp_path / "other").mkdir()
    train("A2C", VECTOR, tmp_path / "other", VecNormalize)
    (tmp_path / "other" / "vecnormalize.pkl").rename(tmp_path / "vecnormalize.pkl")
    result = export_checkpoint(model, tmp_path / "out", vecnormalize="none", notify=notices.append)
    check("SAC", result, VECTOR, model)


def boxes(dtype: Any) -> spaces.Box:
    low, high = (0, 200) if np.dtype(dtype).kind == "u" else (-40, 60)
    return spaces.Box(low, high, (3,), dtype)


FLOATS = [np.float32, np.float64]
OTHERS = [np.float16, np.uint8, np.int8, np.int16, np.int32, np.int64]


@pytest.mark.parametrize("dtype", [*FLOATS, *OTHERS], ids=lambda dtype: np.dtype(dtype).name)
@pytest.mark.parametrize("order", ["stacked", "normalized", "normalized, stacked", "stacked, normalized"])
def test_every_type_of_observation_is_stacked_and_normalized(
    order: str, dtype: Any, tmp_path: Path, notices: list[str]
) -> None:
    space = boxes(dtype)
    model = train("PPO", space, tmp_path, lambda env: wrapped(order, env))
    frames = 3 if "stacked" in order else 1
    if order == "normalized, stacked" and dtype in OTHERS:
        with pytest.raises(UnsupportedError, match=f"VecFrameStack keeps what VecNormalize gives as {space.dtype}"):
            export_checkpoint(model, tmp_path / "out", frame_stack=frames, notify=notices.append)
        return
    result = export_checkpoint(model, tmp_path / "out", frame_stack=frames, notify=notices.append)
    check("PPO", result, space, model, lambda env: wrapped(order, env, tmp_path))


def wrapped(order: str, env: Any, folder: Path | None = None, frames: int = 3) -> Any:
    """Return the environment in the wrappers of `order`, those of `folder` if they were trained."""
    for step in order.split(", "):
        if step == "stacked":
            env = VecFrameStack(env, frames)
        elif step == "normalized":
            env = VecNormalize(env, clip_obs=1.5) if folder is None else frozen(folder, env)
    return env


PARTS = spaces.Dict(
    {
        "pose": spaces.Box(-5, 5, (2,), np.float64),
        "count": boxes(np.int32),
        "touch": spaces.Box(-1, 1, (3,), np.float32),
    }
)


@pytest.mark.parametrize("order", ["normalized, stacked", "stacked, normalized"])
@pytest.mark.parametrize("keys", [["pose"], ["pose", "touch"]], ids="+".join)
def test_parts_of_several_types_are_stacked_and_normalized(
    order: str, keys: list[str], tmp_path: Path, notices: list[str]
) -> None:
    def chosen(env: Any) -> Any:
        for step in order.split(", "):
            env = VecFrameStack(env, 2) if step == "stacked" else VecNormalize(env, norm_obs_keys=keys, clip_obs=1.5)
        return env

    # Stable-Baselines3's replay buffer cannot hold what is stacked above VecNormalize.
    name = "PPO" if order == "normalized, stacked" else "SAC"
    model = train(name, PARTS, tmp_path, chosen, "MultiInputPolicy")
    result = export_checkpoint(model, tmp_path / "out", frame_stack=2, notify=notices.append)
    check(name, result, PARTS, model, lambda env: wrapped(order, env, tmp_path, 2))


class Drifting(BaseFeaturesExtractor):
    """An extractor that counts its calls, in evaluation too."""

    def __init__(self, observation_space: Any) -> None:
        super().__init__(observation_space, int(np.prod(observation_space.shape)))
        self.register_buffer("calls", torch.zeros(()))

    def forward(self, observations: Any) -> Any:
        self.calls += 1.0
        return observations + 0.001 * self.calls


@pytest.mark.parametrize("name", ["PPO", "SAC"])
def test_a_policy_that_changes_as_it_acts_is_refused(name: str, tmp_path: Path, notices: list[str]) -> None:
    kind, action, settings = KINDS[name]
    env = DummyVecEnv([lambda: Recorder(VECTOR, action)])
    parts = {"net_arch": [12], "features_extractor_class": Drifting}
    model = kind("MlpPolicy", env, policy_kwargs=parts, device="cpu", seed=2, **settings)
    model.learn(STEPS)
    model.save(tmp_path / "model")
    with pytest.raises(RlservoError, match=r"changes its '.*calls' each time it acts"):
        export_checkpoint(tmp_path / "model.zip", tmp_path / "out", notify=notices.append)
    assert not (tmp_path / "out").exists()
