"""Models of Stable-Baselines3 and sb3-contrib against `predict(deterministic=True)`, over episodes of the bundle."""

from __future__ import annotations

import base64
import io
import json
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from rlservo.errors import CheckpointError, ParityError, UnsupportedError, UsageError
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.export.verify_bundle import verify_bundle
from rlservo.policy.policy import Policy

sb3 = pytest.importorskip("stable_baselines3")
contrib = pytest.importorskip("sb3_contrib")
torch = pytest.importorskip("torch")

from stable_baselines3.common.torch_layers import BaseFeaturesExtractor  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize  # noqa: E402

VECTOR = spaces.Box(-2, 3, (4,), np.float32)
OPEN = spaces.Box(-np.inf, np.inf, (3,), np.float64)
IMAGE = spaces.Box(0, 255, (36, 40, 3), np.uint8)
BOX = spaces.Box(np.array([-1, -0.5], np.float32), np.array([2, 0.5], np.float32))
ONE, SEVERAL, BITS = spaces.Discrete(4), spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(3)
PARTS = spaces.Dict({"camera": IMAGE, "joints": VECTOR, "mode": spaces.Discrete(3)})
SMALL = {"net_arch": [8]}
MASK = "action_mask"


class Spaces(gymnasium.Env[Any, Any]):
    """An environment of nothing but spaces."""

    def __init__(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}


def make(kind: Any, policy: str, observation: Any, action: Any, vec: Any = None, **settings: Any) -> Any:
    """Return a model with random weights: what matters here, training would not add."""
    env = vec if vec is not None else Spaces(observation, action)
    options: dict[str, Any] = {"policy_kwargs": dict(SMALL), "device": "cpu", "seed": 3, **settings}
    if kind in (sb3.SAC, sb3.TD3, sb3.DDPG, sb3.DQN, contrib.TQC, contrib.QRDQN, contrib.CrossQ):
        options["buffer_size"] = 10
    model = kind(policy, env, **options)
    with torch.no_grad():
        for weights in model.policy.parameters():
            weights.add_(0.1 * torch.randn_like(weights))
    return model


def episodes(result: ExportResult, observations: list[list[Any]]) -> list[Any]:
    """Return the bundle's actions over episodes."""
    actions = []
    with Policy.load(result.path) as policy:
        for episode in observations:
            policy.reset()
            actions += [policy.act(obs) for obs in episode]
    return actions


def samples(space: Any, steps: int, seed: int = 7) -> list[list[Any]]:
    """Return two episodes of observations."""
    space.seed(seed)
    return [[space.sample() for _ in range(steps)] for _ in range(2)]


def same(found: list[Any], wanted: list[Any]) -> None:
    for ours, theirs in zip(found, wanted, strict=True):
        np.testing.assert_allclose(np.asarray(ours, np.float64), np.asarray(theirs, np.float64), rtol=1e-5, atol=2e-6)


CASES = {
    "PPO": (sb3.PPO, "MlpPolicy", VECTOR, BOX),
    "PPO of several choices": (sb3.PPO, "MlpPolicy", spaces.MultiDiscrete([3, 4]), SEVERAL),
    "PPO of bits": (sb3.PPO, "MlpPolicy", spaces.MultiBinary(4), BITS),
    "A2C": (sb3.A2C, "MlpPolicy", OPEN, ONE),
    "SAC": (sb3.SAC, "MlpPolicy", VECTOR, BOX),
    "TD3": (sb3.TD3, "MlpPolicy", VECTOR, BOX),
    "DDPG": (sb3.DDPG, "MlpPolicy", VECTOR, BOX),
    "DQN": (sb3.DQN, "MlpPolicy", spaces.Discrete(5), ONE),
    "TQC": (contrib.TQC, "MlpPolicy", VECTOR, BOX),
    "TRPO": (contrib.TRPO, "MlpPolicy", VECTOR, BOX),
    "QRDQN": (contrib.QRDQN, "MlpPolicy", VECTOR, ONE),
    "CrossQ": (contrib.CrossQ, "MlpPolicy", VECTOR, BOX),
    "ARS": (contrib.ARS, "MlpPolicy", VECTOR, BOX),
    "ARS of a choice": (contrib.ARS, "MlpPolicy", VECTOR, ONE),
    "PPO of a square": (sb3.PPO, "MlpPolicy", spaces.Box(-1, 1, (2, 3), np.float64), spaces.Box(-1, 2, (2, 2))),
    "PPO of images": (sb3.PPO, "CnnPolicy", IMAGE, ONE),
    "SAC of parts": (sb3.SAC, "MultiInputPolicy", PARTS, BOX),
}


@pytest.mark.parametrize("name", CASES)
def test_a_bundle_acts_as_the_model_predicts(name: str, tmp_path: Path, notices: list[str]) -> None:
    kind, policy, observation, action = CASES[name]
    model = make(kind, policy, observation, action)
    model.save(tmp_path / "model")
    result = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", notify=notices.append)
    seen = samples(observation, 6)
    same(episodes(result, seen), [model.predict(obs, deterministic=True)[0] for episode in seen for obs in episode])
    origin = result.contract.provenance
    assert origin.algorithm == name.split()[0] and origin.source == "sb3"
    assert result.path == tmp_path / "out" / "model" / "1"
    assert origin.framework.startswith("Stable-Baselines3 ")
    assert "run code when loaded" in notices[0]


def test_state_dependent_exploration_that_squashes_is_unscaled(tmp_path: Path, notices: list[str]) -> None:
    model = make(sb3.PPO, "MlpPolicy", VECTOR, BOX, use_sde=True, policy_kwargs={**SMALL, "squash_output": True})
    model.save(tmp_path / "model")
    result = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", notify=notices.append)
    seen = samples(VECTOR, 6)
    same(episodes(result, seen), [model.predict(obs, deterministic=True)[0] for episode in seen for obs in episode])
    assert "is exported without exploring actions" in " ".join(notices)


@pytest.mark.parametrize("action", [ONE, SEVERAL, BITS], ids=["one", "several", "bits"])
def test_action_masks_are_a_part_of_the_observation(action: Any, tmp_path: Path, notices: list[str]) -> None:
    inside = spaces.Dict({"joints": VECTOR, "mode": spaces.Discrete(3)}) if action is SEVERAL else VECTOR
    policy = "MultiInputPolicy" if action is SEVERAL else "MlpPolicy"
    model = make(contrib.MaskablePPO, policy, inside, action)
    model.save(tmp_path / "model")
    result = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", notify=notices.append)
    count = {id(ONE): 4, id(SEVERAL): 5, id(BITS): 6}[id(action)]
    rng = np.random.default_rng(0)
    wanted, given = [], []
    for obs in samples(inside, 12)[0]:
        mask = rng.integers(0, 2, count).astype(np.int8)
        mask[[0, -1]] = 1
        if action is SEVERAL:
            mask[3] = 1
        if action is BITS:
            mask[2::2] = 1
        wanted.append(model.predict(obs, deterministic=True, action_masks=mask)[0])
        given.append({**obs, MASK: mask} if isinstance(obs, dict) else {"observations": obs, MASK: mask})
    same(episodes(result, [given]), wanted)
    free = [model.predict(obs, deterministic=True)[0] for obs in samples(inside, 12)[0]]
    assert any((np.asarray(a) != np.asarray(b)).any() for a, b in zip(free, wanted, strict=True)), "no mask mattered"


@pytest.mark.parametrize("action", [BOX, ONE], ids=["box", "discrete"])
def test_a_recurrent_policy_forgets_where_an_episode_starts(action: Any, tmp_path: Path, notices: list[str]) -> None:
    settings = {"policy_kwargs": {"lstm_hidden_size": 5, "n_lstm_layers": 2, **SMALL}}
    model = make(contrib.RecurrentPPO, "MlpLstmPolicy", VECTOR, action, **settings)
    model.save(tmp_path / "model")
    result = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", notify=notices.append)
    seen, wanted = samples(VECTOR, 10), []
    for episode in seen:
        state = None
        for number, obs in enumerate(episode):
            chosen, state = model.predict(obs, state=state, episode_start=np.array([number == 0]), deterministic=True)
            wanted.append(chosen)
    same(episodes(result, seen), wanted)
    assert [leaf.name for leaf in result.contract.state] == ["h", "c"]


def normalized(observation: Any, action: Any, stack: int = 1, *, first: bool = True, **settings: Any) -> Any:
    """Return (VecNormalize, the outermost environment); the statistics are of random observations."""
    vec: Any = DummyVecEnv([lambda: Spaces(observation, action)])
    if stack > 1 and not first:
        vec = VecFrameStack(vec, stack)
    vec = VecNormalize(vec, clip_obs=1.5, **settings)
    vec.reset()
    for _ in range(30):
        vec.step([action.sample()])
    return vec, (VecFrameStack(vec, stack) if stack > 1 and first else vec)


def test_vecnormalize_beside_the_model_is_baked_in_with_its_clip(tmp_path: Path, notices: list[str]) -> None:
    vec, env = normalized(OPEN, BOX)
    model = make(sb3.PPO, "MlpPolicy", OPEN, BOX, env)
    model.save(tmp_path / "model_30_steps")
    vec.save(tmp_path / "model_vecnormalize_30_steps.pkl")
    result = export_checkpoint(tmp_path / "model_30_steps.zip", tmp_path / "out", notify=notices.append)
    seen = [[3.0 * obs for obs in episode] for episode in samples(OPEN, 8)]  # many of them at the clip
    wanted = [model.predict(vec.normalize_obs(obs), deterministic=True)[0] for episode in seen for obs in episode]
    same(episodes(result, seen), wanted)
    assert result.contract.baked_in[0].step == "mean_std_filter" and result.contract.baked_in[0].values["clip"] == 1.5
    assert result.contract.baked_in[0].values["count"] >= 30
    checked = verify_bundle(result.path, tmp_path / "model_30_steps.zip", notify=notices.append)
    assert checked.same_checkpoint and checked.parity.samples > 700


def test_only_some_parts_are_normalized(tmp_path: Path, notices: list[str]) -> None:
    parts = spaces.Dict({"joints": OPEN, "target": VECTOR, "mode": spaces.Discrete(3)})
    vec, env = normalized(parts, BOX, norm_obs_keys=["joints"])
    model = make(sb3.PPO, "MultiInputPolicy", parts, BOX, env)
    model.save(tmp_path / "model")
    vec.save(tmp_path / "elsewhere.pkl")
    result = export_checkpoint(
        tmp_path / "model.zip", tmp_path / "out", vecnormalize=tmp_path / "elsewhere.pkl", notify=notices.append
    )
    seen = samples(parts, 8)
    wanted = [model.predict(vec.normalize_obs(obs), deterministic=True)[0] for episode in seen for obs in episode]
    same(episodes(result, seen), wanted)
    again = {"source": "sb3", "notify": notices.append}
    checked = verify_bundle(result.path, tmp_path / "model.zip", vecnormalize=tmp_path / "elsewhere.pkl", **again)
    assert checked.parity.samples > 700
    with pytest.raises(ParityError):
        verify_bundle(result.path, tmp_path / "model.zip", **again)
    with pytest.raises(UsageError, match="there is no source 'sb2': expected one of rllib"):
        verify_bundle(result.path, tmp_path / "model.zip", source="sb2", notify=notices.append)


class InOrder(BaseFeaturesExtractor):
    """Reads the parts of an observation in the order in which they come."""

    def __init__(self, observation_space: Any) -> None:
        super().__init__(observation_space, 8)

    def forward(self, obs: Any) -> Any:
        return torch.cat(list(obs.values()), dim=-1)


@pytest.mark.parametrize("frames", [1, 2])
def test_parts_come_in_the_order_of_the_models_space(frames: int, tmp_path: Path, notices: list[str]) -> None:
    size = 4 // frames
    space = spaces.Dict([("wheels", spaces.Box(-1, 1, (size,))), ("arm", spaces.Box(-1, 1, (size,)))])
    env: Any = DummyVecEnv([lambda: Spaces(space, BOX)])
    env = env if frames == 1 else VecFrameStack(env, frames)
    assert list(env.reset()) == ["wheels", "arm"]
    assert list(env.observation_space.spaces) == (["wheels", "arm"] if frames == 1 else ["arm", "wheels"])
    extractor = {"policy_kwargs": {**SMALL, "features_extractor_class": InOrder}}
    model = make(sb3.PPO, "MultiInputPolicy", space, BOX, env, **extractor)
    model.save(tmp_path / "model")
    options: dict[str, Any] = {"frame_stack": frames, "notify": notices.append}
    if frames > 1:  # the zip does not hold the order of what the stack gives
        with pytest.raises(UnsupportedError, match="when its keys come in the opposite order"):
            export_checkpoint(tmp_path / "model.zip", tmp_path / "out", **options)
        return
    result = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", **options)
    seen = samples(space, 6)
    same(episodes(result, seen), [model.predict(obs, deterministic=True)[0] for episode in seen for obs in episode])


@pytest.mark.parametrize("first", [True, False], ids=["normalized, then stacked", "stacked, then normalized"])
def test_frames_are_stacked_from_an_episodes_start(first: bool, tmp_path: Path, notices: list[str]) -> None:
    vec, env = normalized(VECTOR, BOX, 3, first=first)
    model = make(sb3.PPO, "MlpPolicy", VECTOR, BOX, env)
    model.save(tmp_path / "model")
    vec.save(tmp_path / "vecnormalize.pkl")
    result = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", frame_stack=3, notify=notices.append)
    assert result.contract.observation_space.shape == (4,)
    seen, wanted = samples(VECTOR, 6), []
    for episode in seen:
        frames = [np.zeros(4, np.float32)] * 3
        for obs in episode:
            frames = [*frames[1:], vec.normalize_obs(obs) if first else obs]
            stacked = np.concatenate(frames)
            wanted.append(model.predict(stacked if first else vec.normalize_obs(stacked), deterministic=True)[0])
    same(episodes(result, seen), wanted)


def test_stacked_images_keep_their_channels_last(tmp_path: Path, notices: list[str]) -> None:
    env = VecFrameStack(DummyVecEnv([lambda: Spaces(IMAGE, ONE)]), 2)
    model = make(sb3.DQN, "CnnPolicy", IMAGE, ONE, env)
    model.save(tmp_path / "model")
    result = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", frame_stack=2, notify=notices.append)
    assert result.contract.observation_space.shape == IMAGE.shape
    seen, wanted = samples(IMAGE, 4), []
    for episode in seen:
        last = np.zeros(IMAGE.shape, np.uint8)
        for obs in episode:
            wanted.append(model.predict(np.concatenate([last, obs], axis=-1), deterministic=True)[0])
            last = obs
    same(episodes(result, seen), wanted)


UNEVEN = spaces.Box(np.array([-1, -2], np.float32), np.array([3, 4], np.float32))


def test_the_bounds_of_a_stacks_frame_are_the_environments(tmp_path: Path, notices: list[str]) -> None:
    env = VecFrameStack(DummyVecEnv([lambda: Spaces(UNEVEN, BOX)]), 4)
    model = make(sb3.PPO, "MlpPolicy", UNEVEN, BOX, env)
    model.save(tmp_path / "model")
    options: dict[str, Any] = {"notify": notices.append}
    result = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", frame_stack=4, **options)
    space = result.contract.observation_space
    assert (space.low, space.high) == ((-1.0, -2.0), (3.0, 4.0))
    assert any("taken for 4 frames of one VecFrameStack, of shape (2,) each" in notice for notice in notices)
    with pytest.raises(CheckpointError, match="not those that a VecFrameStack of 8 frames gives"):
        export_checkpoint(tmp_path / "model.zip", tmp_path / "out", frame_stack=8, **options)
    seen, wanted = samples(UNEVEN, 6), []
    for episode in seen:
        frames = [np.zeros(2, np.float32)] * 4
        for obs in episode:
            frames = [*frames[1:], obs]
            wanted.append(model.predict(np.concatenate(frames), deterministic=True)[0])
    same(episodes(result, seen), wanted)


def test_statistics_of_normalized_numbers_are_pointed_out(tmp_path: Path, notices: list[str]) -> None:
    def train(env: Any, folder: str) -> None:
        vec = VecNormalize(env)
        model = make(sb3.PPO, "MlpPolicy", VECTOR, BOX, vec)
        vec.reset()
        for _ in range(300):
            vec.step(np.zeros((1, 2), np.float32))
        (tmp_path / folder).mkdir()
        model.save(tmp_path / folder / "model")
        vec.save(tmp_path / folder / "vecnormalize.pkl")
        export_checkpoint(tmp_path / folder / "model.zip", tmp_path / "out", name=folder, notify=notices.append)

    train(DummyVecEnv([lambda: Spaces(VECTOR, BOX)]), "once")
    assert not any("normalized already" in notice for notice in notices)
    train(VecNormalize(DummyVecEnv([lambda: Spaces(VECTOR, BOX)])), "twice")
    assert any("if another VecNormalize was below it" in notice for notice in notices)


class Predicts(sb3.common.policies.ActorCriticPolicy):
    """Gives a state, although it has no memory that training knows of."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        actions, _ = super().predict(observation, deterministic=deterministic)
        count = 0 if state is None else state[0] + 1
        return (actions if count < 5 else 0 * actions), (count,)


class Rounds(sb3.sac.policies.SACPolicy):
    def _predict(self, observation: Any, deterministic: bool = False) -> Any:
        actions = super()._predict(observation, deterministic)
        return -actions if bool((observation > 1e6).any()) else actions


class Cleans(sb3.common.policies.ActorCriticPolicy):
    def obs_to_tensor(self, observation: Any) -> Any:
        return super().obs_to_tensor(np.where(np.abs(observation) > 1e6, 0, observation))


class Forwards(sb3.td3.policies.TD3Policy):
    def forward(self, observation: Any, deterministic: bool = False) -> Any:
        return super().forward(observation, deterministic)


class Network(sb3.dqn.policies.QNetwork):
    def _predict(self, observation: Any, deterministic: bool = True) -> Any:
        return super()._predict(observation, deterministic)


class HasNetwork(sb3.dqn.policies.DQNPolicy):
    def make_q_net(self) -> Any:
        return Network(**self._update_features_extractor(self.net_args, features_extractor=None)).to(self.device)


@pytest.mark.parametrize(
    ("kind", "policy", "action", "words"),
    [
        (sb3.PPO, Predicts, BOX, r"test_sb3\.Predicts has a 'predict' of its own"),
        (sb3.PPO, Cleans, BOX, r"test_sb3\.Cleans has a 'obs_to_tensor' of its own"),
        (sb3.SAC, Rounds, BOX, r"test_sb3\.Rounds has a '_predict' of its own"),
        (sb3.TD3, Forwards, BOX, r"test_sb3\.Forwards has a 'forward' of its own"),
        (sb3.DQN, HasNetwork, ONE, r"test_sb3\.Network has a '_predict' of its own"),
    ],
)
def test_a_policy_that_acts_outside_of_its_networks_is_refused(
    kind: Any, policy: Any, action: Any, words: str, tmp_path: Path, notices: list[str]
) -> None:
    make(kind, policy, VECTOR, action).save(tmp_path / "model")
    with pytest.raises(UnsupportedError, match=words):
        export_checkpoint(tmp_path / "model.zip", tmp_path / "out", notify=notices.append)


class StopsForARareOne(sb3.common.policies.ActorCriticPolicy):
    """Acts otherwise behind its networks for an observation that is no sample."""

    def get_distribution(self, obs: Any) -> Any:
        found = super().get_distribution(obs)
        found.distribution.loc = torch.where(obs[:, :1] == 0.3, 0.1, found.distribution.loc)
        return found


class ChoosesOtherwise(sb3.common.distributions.DiagGaussianDistribution):
    def mode(self) -> Any:
        return super().mode().clamp(max=0.1)


class HasDistribution(sb3.common.policies.ActorCriticPolicy):
    def __init__(self, *given: Any, **settings: Any) -> None:
        super().__init__(*given, **settings)
        self.action_dist = ChoosesOtherwise(2)


@pytest.mark.parametrize("policy", [StopsForARareOne, HasDistribution])
def test_what_an_own_class_does_behind_its_networks_is_in_the_graph(
    policy: Any, tmp_path: Path, notices: list[str]
) -> None:
    model = make(sb3.PPO, policy, VECTOR, BOX)
    model.save(tmp_path / "model")
    result = export_checkpoint(tmp_path / "model.zip", tmp_path / "out", notify=notices.append)
    seen = samples(VECTOR, 6)
    seen[0][0][0] = 0.3
    same(episodes(result, seen), [model.predict(obs, deterministic=True)[0] for episode in seen for obs in episode])


class TestBroken:
    @pytest.fixture
    def model(self, tmp_path: Path) -> Path:
        make(sb3.PPO, "MlpPolicy", VECTOR, BOX).save(tmp_path / "model")
        return tmp_path / "model.zip"

    def refused(self, model: Path, words: str, kind: type[Exception] = CheckpointError, **options: Any) -> None:
        with pytest.raises(kind, match=words):
            export_checkpoint(model, model.parent / "out", notify=lambda _: None, **options)
        assert not (model.parent / "out").exists()

    def test_statistics_of_other_observations(self, model: Path) -> None:
        vec, _ = normalized(OPEN, BOX)
        vec.save(model.with_name("vecnormalize.pkl"))
        self.refused(model, r"statistics are for observations \(3,\), but the model's are \(4,\): they do not belong")

    def test_statistics_that_are_none(self, model: Path) -> None:
        model.with_name("vecnormalize.pkl").write_bytes(pickle.dumps({"mean": 0}))
        self.refused(model, "holds a dict: expected what VecNormalize.save wrote")
        model.with_name("vecnormalize.pkl").unlink()
        self.refused(model, "cannot be read: No such file", vecnormalize=model.with_name("nothing.pkl"))

    def test_statistics_of_no_observation(self, model: Path) -> None:
        VecNormalize(DummyVecEnv([lambda: Spaces(VECTOR, BOX)])).save(model.with_name("vecnormalize.pkl"))
        self.refused(model, "VecNormalize's statistics come from 0 observations")

    def test_a_policy_class_that_cannot_be_imported(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, notices: list[str]
    ) -> None:
        code = "from stable_baselines3.common.policies import ActorCriticPolicy\nclass Mine(ActorCriticPolicy): ...\n"
        (tmp_path / "code").mkdir()
        (tmp_path / "code" / "their_policies.py").write_text(code)
        monkeypatch.syspath_prepend(str(tmp_path / "code"))
        import their_policies  # type: ignore[import-not-found]  # the test wrote it

        make(sb3.PPO, their_policies.Mine, VECTOR, BOX).save(tmp_path / "model")
        monkeypatch.undo()
        sys.modules.pop("their_policies")
        self.refused(tmp_path / "model.zip", "its 'policy_class' cannot be loaded: it needs the Python module "
                     "'their_policies'")  # fmt: skip
        result = export_checkpoint(
            tmp_path / "model.zip", tmp_path / "out", app_dir=tmp_path / "code", notify=notices.append
        )
        assert result.contract.provenance.module_class == "their_policies.Mine"
        sys.modules.pop("their_policies")

    def test_weights_that_are_not_finite(self, tmp_path: Path) -> None:
        model = make(sb3.PPO, "MlpPolicy", VECTOR, BOX)
        with torch.no_grad():
            model.policy.action_net.weight[0, 0] = float("nan")
        model.save(tmp_path / "model")
        self.refused(tmp_path / "model.zip", "'action_net.weight' are not all finite: training diverged")

    def test_frames_that_do_not_divide_the_observation(self, model: Path) -> None:
        self.refused(model, "is not a stack of 3 frames", frame_stack=3)

    def test_actions_that_are_whole_numbers(self, tmp_path: Path) -> None:
        make(sb3.PPO, "MlpPolicy", VECTOR, spaces.Box(0, 5, (2,), np.int32)).save(tmp_path / "model")
        self.refused(tmp_path / "model.zip", "expected float32 or float64", UnsupportedError)

    def test_weights_of_another_observation(self, tmp_path: Path) -> None:
        model = make(sb3.PPO, "MlpPolicy", VECTOR, BOX)
        model.observation_space = OPEN
        model.save(tmp_path / "model")
        self.refused(tmp_path / "model.zip", "cannot be restored as PPO: .*size mismatch for mlp_extractor")

    def test_two_models_in_a_folder(self, model: Path) -> None:
        model.with_name("other.zip").write_bytes(model.read_bytes())
        self.refused(model.parent, r"holds 2 models \(model.zip, other.zip\): name one of them")


def rewritten(model: Path, **members: bytes) -> Path:
    """Replace members of a model's zip, compressed."""
    with zipfile.ZipFile(model) as archive:
        kept = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(model, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {
            **kept,
            **{name.replace("__", "."): content for name, content in members.items()},
        }.items():
            archive.writestr(name, content)
    return model


class Harmful:
    def __reduce__(self) -> Any:
        return print, ("the weights ran code",)


def saved(content: Any) -> bytes:
    """Return what torch.save writes."""
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def setting(name: str, value: Any) -> Callable[[Path], Path]:
    """Return a function that changes one of a model's settings."""

    def change(model: Path) -> Path:
        with zipfile.ZipFile(model) as archive:
            data = json.loads(archive.read("data"))
        return rewritten(model, data=json.dumps({**data, name: value}).encode())

    return change


def encrypted(model: Path) -> Path:
    """Mark the members as encrypted, as a zip with a password has them."""
    content = bytearray(model.read_bytes())
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = content.find(signature)
        while place >= 0:
            content[place + flags] |= 1
            place = content.find(signature, place + 4)
    model.write_bytes(content)
    return model


DAMAGED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a list": (lambda model: rewritten(model, data=b"[1, 2]"), "its 'data' is a JSON list, expected the settings"),
    "deep": (lambda model: rewritten(model, data=b"[" * 200_000), "its 'data' is nested too deeply"),
    "encrypted": (encrypted, "cannot be read: File 'data' is encrypted, password required"),
    "a bomb": (lambda model: rewritten(model, data=b" " * 100_000_000), "it has a member of 100,000,000 bytes in a"),
    "a bomb of weights": (lambda model: rewritten(model, policy__pth=bytes(100_000_000)), "it has a member of 100,0"),
    "a pickle": (lambda model: rewritten(model, policy__pth=pickle.dumps(Harmful())),
                 "its weights are not tensors alone: the file is damaged, or no file of torch.save, and cannot"),
    "code": (lambda model: rewritten(model, policy__pth=saved(Harmful())),
             "its weights are not tensors alone: the file names the code 'print', and cannot be loaded$"),
    "no weights": (lambda model: rewritten(model, policy__pth=b"none"),
                   "its weights are not tensors alone: the file is damaged, or no file of torch.save, and cannot"),
    "no class": (setting("policy_class", 3), "its 'policy_class' is '3', expected a class"),
    "no pickle": (setting("observation_space", {":serialized:": 5}), "its 'observation_space' is not base64"),
    "no space": (setting("observation_space", "Box"), "cannot be restored as PPO"),
    "of gym": (setting("observation_space", {":serialized:": base64.b64encode(b"cgym.spaces.box\nBox\n.").decode()}),
               "Stable-Baselines3 1 with Gym's spaces: .* needs gym and shimmy: pip install gym==0.26.2 shimmy$"),
    "no settings": (setting("policy_kwargs", 7), "cannot be restored as PPO"),
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_model_is_refused_in_one_sentence(
    damage: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    make(sb3.PPO, "MlpPolicy", VECTOR, BOX).save(tmp_path / "model")
    change, words = DAMAGED[damage]
    model = change(tmp_path / "model.zip")
    with pytest.raises(CheckpointError, match=words) as refused:
        export_checkpoint(model, tmp_path / "out", notify=lambda _: None)
    assert "\n" not in str(refused.value) and "weights_only" not in str(refused.value)
    assert "ran code" not in capfd.readouterr().out
    assert not (tmp_path / "out").exists()


def test_reading_a_zip_starts_nothing_and_imports_no_ray(tmp_path: Path) -> None:
    make(sb3.PPO, "MlpPolicy", VECTOR, BOX).save(tmp_path / "model")
    program = (
        "import sys, warnings; warnings.simplefilter('error')\n"
        "import gymnasium\n"
        "def refuse(*a, **k): raise AssertionError('an environment was made')\n"
        "gymnasium.make = gymnasium.Env.__init__ = refuse\n"
        "from rlservo.export.export_checkpoint import export_checkpoint\n"
        f"export_checkpoint({str(tmp_path / 'model.zip')!r}, {str(tmp_path / 'out')!r}, notify=print)\n"
        "print('ray' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "False"
