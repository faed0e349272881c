"""The wider zoo: spaces, recurrent policies, connectors and algorithms. See train_zoo.py, whose tools it uses.

python train_wide_zoo.py OUT [NAME...]
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import torch
from ray import tune
from ray.rllib.algorithms.appo import APPOConfig
from ray.rllib.algorithms.bc import BCConfig
from ray.rllib.algorithms.cql import CQLConfig
from ray.rllib.algorithms.dqn import DQNConfig
from ray.rllib.algorithms.impala import IMPALAConfig
from ray.rllib.algorithms.iql import IQLConfig
from ray.rllib.algorithms.marwil import MARWILConfig
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.algorithms.tqc import TQCConfig
from ray.rllib.connectors.env_to_module import FlattenObservations, MeanStdFilter, PrevActionsPrevRewards
from ray.rllib.connectors.env_to_module.frame_stacking import FrameStackingEnvToModule
from ray.rllib.connectors.learner.frame_stacking import FrameStackingLearner
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env import INPUT_ENV_SPACES
from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
from ray.rllib.examples.rl_modules.classes.autoregressive_actions_rlm import AutoregressiveActionsRLM
from ray.rllib.examples.rl_modules.classes.modelv2_to_rlm import ModelV2ToRLModule
from ray.rllib.offline.offline_data import OfflineData
from ray.rllib.offline.offline_prelearner import OfflinePreLearner

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "app"), str(HERE)]
import zoo_rules  # noqa: E402  # pyright: ignore[reportMissingImports]
import zoo_spaces  # noqa: E402  # pyright: ignore[reportMissingImports]  # in app/, added to the path above
import zoo_team  # noqa: E402  # pyright: ignore[reportMissingImports]
from train_zoo import leaves, ray_for_training, record  # noqa: E402  # pyright: ignore[reportMissingImports]

from rlservo.export.rllib.batched_connectors import use_batched_connectors  # noqa: E402

SMALL = DefaultModelConfig(fcnet_hiddens=[16])
LSTM = DefaultModelConfig(fcnet_hiddens=[8], use_lstm=True, lstm_cell_size=8, max_seq_len=10)
CNN = DefaultModelConfig(
    conv_filters=[[4, 4, 2], [8, 3, 2]], head_fcnet_hiddens=[8], fcnet_hiddens=[8], conv_activation="relu"
)


def pieces(*kinds: Any) -> Any:
    def make(env: Any = None, spaces: Any = None, device: Any = None) -> Any:
        return [kind() for kind in kinds]

    return make


def previous() -> Any:
    return PrevActionsPrevRewards(n_prev_actions=2, n_prev_rewards=3)


def stacked() -> Any:
    return FrameStackingEnvToModule(num_frames=3)


def stacked_for_learning(input_observation_space: Any, input_action_space: Any, device: Any = None) -> Any:
    return FrameStackingLearner(num_frames=3)


def spaces_env(config: Any, obs: str, action: str, *before: Any, after: Any = None, **runners: Any) -> Any:
    config.environment("spaces", env_config={"obs": obs, "action": action})
    runners = {"num_env_runners": 0, **runners}
    if before:
        runners["env_to_module_connector"] = pieces(*before)
    if after:
        runners["module_to_env_connector"] = lambda env=None, spaces=None: after()
    return config.env_runners(**runners)


def ppo(obs: str, action: str, *before: Any, model: Any = SMALL, spec: Any = None, after: Any = None) -> Any:
    config = spaces_env(PPOConfig(), obs, action, *before, after=after)
    config.training(train_batch_size=64, minibatch_size=32, num_epochs=1)
    return config.rl_module(rl_module_spec=spec) if spec else config.rl_module(model_config=model)


def stacked_vectors() -> Any:
    config = ppo("vector", "box")
    use_batched_connectors(
        config, observation_filter=True, logarithm_of=(0, 2), sine_and_cosine_of=(1,), num_frames=3, every=2
    )
    return config


def off_policy(config: Any, obs: str, action: str, *before: Any, model: Any = SMALL, **training: Any) -> Any:
    spaces_env(config, obs, action, *before, rollout_fragment_length=1)
    config.reporting(min_sample_timesteps_per_iteration=20, min_time_s_per_iteration=0)
    config.training(num_steps_sampled_before_learning_starts=8, train_batch_size_per_learner=8, **training)
    return config.rl_module(model_config=model)


def recorded(folder: Path, action: str) -> str:
    """Write six random episodes as the rows RLlib's offline algorithms read; return their folder."""
    env = zoo_spaces.Spaces({"obs": "vector", "action": action})
    env.action_space.seed(0)
    rows: list[dict[str, Any]] = []
    for episode in range(6):
        obs, done = env.reset(seed=episode)[0], False
        while not done:
            chosen = env.action_space.sample()
            after, reward, done, _, _ = env.step(chosen)
            row = {"eps_id": str(episode), "obs": obs.tolist(), "actions": np.asarray(chosen).tolist()}
            rows.append({**row, "rewards": reward, "new_obs": after.tolist(), "terminateds": done, "truncateds": False})
            obs = after
    target = folder / f"recorded_{action}"
    target.mkdir(exist_ok=True)
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), str(target / "rows.parquet"))
    return str(target)


class RowsInProcess(OfflineData):
    """RLlib's own preparation of recorded rows, in this process: Ray Data's workers take half a minute to start."""

    def __init__(self, config: Any) -> None:
        self.config = config
        self.iter_batches_kwargs: dict[str, Any] = {}
        table = pyarrow.parquet.read_table(f"{config.input_[0]}/rows.parquet")
        self.rows = {name: np.array(table[name].to_pylist()) for name in table.column_names}

    def sample(
        self, num_samples: int, return_iterator: bool = False, num_shards: int = 1, module_state: Any = None
    ) -> Any:
        state = self.learner_handles[0].get_state(component=COMPONENT_RL_MODULE)[COMPONENT_RL_MODULE]
        spaces = self.spaces[INPUT_ENV_SPACES]
        prepare = OfflinePreLearner(config=self.config, spaces=spaces, module_spec=self.module_spec, module_state=state)
        return [Batches(prepare, self.rows)]


class Batches:
    """The one method of a Ray Data iterator that a learner calls."""

    def __init__(self, prepare: Any, rows: dict[str, Any]) -> None:
        self.prepare = prepare
        self.rows = rows

    def iter_torch_batches(self, batch_size: int, device: Any = None, **_: Any) -> Any:
        prepared = self.prepare({name: values[:batch_size] for name, values in self.rows.items()})
        return [{name: torch.as_tensor(np.asarray(values)) for name, values in prepared.items()}]


def offline(config: Any, data: str, action: str, **training: Any) -> Any:
    env = zoo_spaces.Spaces({"obs": "vector", "action": action})
    spaces_env(config, "vector", action)
    config.environment(observation_space=env.observation_space, action_space=env.action_space)
    config.offline_data(
        input_=[data],
        dataset_num_iters_per_learner=2,  # CQL's training step takes no batch, only an iterator (ray 2.60)
        offline_data_class=RowsInProcess,
    )
    config.evaluation(evaluation_interval=1, evaluation_num_env_runners=0, evaluation_duration=1)
    config.learners(num_learners=0).training(train_batch_size_per_learner=32, **training)
    config.reporting(min_time_s_per_iteration=0)  # by itself CQL goes on for a second
    return config.rl_module(model_config=SMALL)


def team(*before: Any, together: Any = None) -> Any:
    """Two arms that share a module, and a base whose module has a memory."""
    specs = {"arms": RLModuleSpec(model_config=SMALL), "wheels": RLModuleSpec(model_config=LSTM)}
    given = {"multi_rl_module_class": together} if together else {}
    config = PPOConfig().environment("team").env_runners(num_env_runners=0)
    if before:
        config.env_runners(env_to_module_connector=pieces(*before))
    config.training(train_batch_size=32, minibatch_size=16, num_epochs=1)
    config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs=specs, **given))
    return config.multi_agent(policies=set(specs), policy_mapping_fn=zoo_team.module_of)


def filtered_each() -> Any:
    return MeanStdFilter(multi_agent=True)


def record_team(algorithm: Any, out: Path, name: str) -> None:
    """Let RLlib roll out by itself and write down what each agent saw and did."""
    for agent, seen in team_rollout(algorithm.env_runner).items():
        np.savez(out / f"{name}_{agent}.npz", **seen)


def team_rollout(runner: Any) -> dict[str, dict[str, Any]]:
    """Return what each agent of an environment runner sees and does."""
    for piece in runner._env_to_module.connectors:
        if isinstance(piece, MeanStdFilter):
            piece._update_stats = False
    runner.sample(num_timesteps=1, explore=False, force_reset=True)  # drops observations filtered before the freeze
    env = runner.env.envs[0].unwrapped
    seen: dict[str, list[dict[str, Any]]] = {agent: [] for agent in env.possible_agents}
    last: dict[str, Any] = {}
    real_reset, real_step = env.reset, env.step

    def reset(**kwargs: Any) -> Any:
        obs, info = real_reset(**kwargs)
        last.update(obs={agent: leaves(one, "obs") for agent, one in obs.items()}, restart=True)
        return obs, info

    def step(action: Any) -> Any:
        for agent, rows in seen.items():
            if last:
                chosen = np.copy(action[agent])
                rows.append({**last["obs"][agent], "action": chosen, "restart": last["restart"]})
        result = real_step(action)
        last.update(obs={agent: leaves(one, "obs") for agent, one in result[0].items()}, restart=False)
        return result

    env.reset, env.step = reset, step
    runner.sample(num_timesteps=60, explore=False, force_reset=True)
    assert all(len(rows) >= 50 for rows in seen.values())
    return {agent: {key: np.stack([row[key] for row in rows]) for key in rows[0]} for agent, rows in seen.items()}


def configurations(out: Path) -> dict[str, Any]:
    flat = FlattenObservations
    choices, numbers = (recorded(out, action) for action in ("discrete", "box"))
    impala = spaces_env(IMPALAConfig(), "vector", "box").learners(num_learners=0).rl_module(model_config=SMALL)
    appo = spaces_env(APPOConfig(), "vector", "multi_discrete").learners(num_learners=0).rl_module(model_config=LSTM)
    for config in (impala, appo):
        config.reporting(min_time_s_per_iteration=0)  # by themselves they go on for ten seconds
    gru = RLModuleSpec(module_class=zoo_spaces.GruModule, model_config={"max_seq_len": 10})
    episodes = {"type": "EpisodeReplayBuffer", "capacity": 1000}
    masking = RLModuleSpec(module_class=ActionMaskingTorchRLModule, model_config={"head_fcnet_hiddens": [8]})
    old = PPOConfig().api_stack(enable_rl_module_and_learner=False, enable_env_runner_and_connector_v2=False)
    old_inside = RLModuleSpec(
        module_class=ModelV2ToRLModule,
        model_config={"old_api_stack_algo_config": old.training(model={"fcnet_hiddens": [8]})},
    )
    return {
        "lstm_box": ppo("vector", "box", MeanStdFilter, model=LSTM),
        "lstm_discrete": ppo("vector", "discrete", model=LSTM),
        "lstm_previous": ppo("vector", "discrete", previous, flat, model=LSTM),
        "previous": ppo("discrete", "discrete", previous, flat),
        "user_gru": ppo("vector", "discrete", spec=gru),
        "appo_lstm": appo.training(train_batch_size_per_learner=64),
        "obs_discrete": ppo("discrete", "box", flat),
        "obs_below_zero": ppo("below_zero", "discrete", flat),
        "obs_multi_discrete": ppo("multi_discrete", "discrete", flat),
        "obs_multi_binary": ppo("multi_binary", "discrete", flat),
        "obs_integers": ppo("integers", "discrete", flat, MeanStdFilter),
        "obs_integers_filtered_first": ppo("integers", "discrete", MeanStdFilter, flat),
        "obs_bytes": ppo("bytes", "discrete", flat),
        "obs_dict": ppo("dict", "discrete", flat),
        "obs_tuple": ppo("tuple", "discrete", flat, MeanStdFilter),
        "obs_nested": ppo("nested", "box", flat),
        "dict_module": ppo("dict", "discrete", spec=RLModuleSpec(module_class=zoo_spaces.DictModule)),
        "greedy_module": ppo("dict", "discrete", spec=RLModuleSpec(module_class=zoo_spaces.GreedyModule)),
        "image": ppo("image", "discrete", model=CNN),
        "byte_image": ppo("byte_image", "discrete", spec=RLModuleSpec(module_class=zoo_spaces.ByteImageModule)),
        "stacked": ppo("gray", "discrete", stacked, model=CNN).learners(learner_connector=stacked_for_learning),
        "stacked_vectors": stacked_vectors(),
        "act_multi_discrete": ppo("vector", "multi_discrete"),
        "act_dict": ppo("vector", "dict"),
        "act_tuple": ppo("vector", "tuple"),
        "act_scalar": ppo("vector", "scalar"),
        "act_nested": ppo("nested", "nested", flat, model=LSTM),
        "masked": ppo("masked", "discrete", spec=masking),
        "byte_masked": ppo("byte_masked", "discrete", spec=masking),
        "user_distribution": ppo("vector", "box", spec=RLModuleSpec(module_class=zoo_rules.BetaModule)),
        "old_model_inside": ppo("vector", "discrete", spec=old_inside),
        "branching": ppo("vector", "discrete", spec=RLModuleSpec(module_class=zoo_rules.BranchingModule)),
        "autoregressive": ppo("vector", "autoregressive", spec=RLModuleSpec(module_class=AutoregressiveActionsRLM)),
        "scaled": ppo("vector", "discrete", zoo_spaces.Scaled),
        "polar": ppo("vector", "box", zoo_spaces.Polar),
        "bearing_module": ppo("vector", "discrete", spec=RLModuleSpec(module_class=zoo_spaces.BearingModule)),
        "wrongly_scaled": ppo("vector", "discrete", zoo_spaces.WronglyScaled),
        "halved": ppo("vector", "box", after=zoo_spaces.Halved),
        "bc": offline(BCConfig(), choices, "discrete"),
        "marwil": offline(MARWILConfig(), numbers, "box"),
        "cql": offline(CQLConfig(), numbers, "box", lr=None),
        "iql": offline(IQLConfig(), numbers, "box"),
        "impala": impala.training(train_batch_size_per_learner=64),
        "sac_discrete": off_policy(SACConfig(), "vector", "discrete"),
        "tqc": off_policy(TQCConfig(), "vector", "box", MeanStdFilter),
        "dqn_plain": off_policy(DQNConfig(), "vector", "discrete", dueling=False, double_q=False),
        "dqn_distributional": off_policy(DQNConfig(), "dict", "discrete", flat, num_atoms=5, v_min=-3.0, v_max=3.0),
        "dqn_distributional_plain": off_policy(DQNConfig(), "vector", "discrete", dueling=False, num_atoms=5),
        "team": team(filtered_each),
        "plain_team": team(),
        "committee": team(together=zoo_team.Committee),
        "dqn_lstm": off_policy(DQNConfig(), "vector", "discrete", model=LSTM, replay_buffer_config=episodes),
    }  # fmt: skip


def main(out: Path, only: list[str]) -> None:
    tune.register_env("spaces", zoo_spaces.Spaces)
    tune.register_env("team", zoo_team.Team)
    with ray_for_training():
        for name, config in configurations(out).items():
            if only and name not in only:
                continue
            algorithm = config.build_algo()
            algorithm.train()
            algorithm.save_to_path(str(out / name))
            # An environment runner may lag behind its learner, and the checkpoint holds the learner's weights.
            if algorithm.env_runner is not None:
                algorithm.restore_from_path(str(out / name))
            if "team" in name:
                record_team(algorithm, out, name)
            elif name != "committee":
                record(algorithm, out / f"{name}.npz")
            algorithm.stop()
            print(name, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
