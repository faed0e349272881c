"""Train the old-API-stack checkpoints the export tests read: one small RLlib iteration each, then record.

    python train_old_zoo.py OUT [NAME...]

writes OUT/<name>/ (a checkpoint) and OUT/<name>.npz (what the environment saw in RLlib's own evaluation: observations,
and the actions that reached `env.step`, exploration off and the filter frozen). It runs in a process of its own and
starts a cluster of its own, which it stops.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from ray import tune
from ray.rllib.algorithms.appo import APPOConfig
from ray.rllib.algorithms.cql import CQLConfig
from ray.rllib.algorithms.dqn import DQN, DQNConfig
from ray.rllib.algorithms.impala import IMPALAConfig
from ray.rllib.algorithms.marwil import MARWILConfig
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.algorithms.sac import SACConfig
from ray.rllib.examples._old_api_stack.models.action_mask_model import TorchActionMaskModel
from ray.rllib.policy.policy import PolicySpec
from ray.rllib.utils.from_config import from_config
from ray.rllib.utils.replay_buffers import ReplayBuffer

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parent / "app"))
import old_zoo_parts  # pyright: ignore[reportMissingImports]  # in app/, added to the path above
import old_zoo_registry  # pyright: ignore[reportMissingImports]
from train_zoo import leaves, ray_for_training  # pyright: ignore[reportMissingImports]

STEPS = 100  # recorded
REFUSED = {
    "noisy_dqn", "noisy_weights", "batch_reader", "previous_action", "clock_reader", "attention", "previous_lstm",
    "clipped_limbs", "own_policy",
}  # fmt: skip
REPLAY = {"type": "MultiAgentPrioritizedReplayBuffer", "capacity": 100}


def old(config: Any, env: str, *, filtered: str = "NoFilter", kind: str = "", **environment: Any) -> Any:
    config.api_stack(enable_rl_module_and_learner=False, enable_env_runner_and_connector_v2=False)
    config.environment(env, env_config={"kind": kind} if kind else {}, **environment)
    config.env_runners(num_env_runners=0, observation_filter=filtered).debugging(seed=1)
    config.reporting(min_time_s_per_iteration=0)  # by itself SAC goes on for a second, APPO for ten
    # An interval that is never reached: evaluation happens when it is asked for, with an environment of its own.
    config.evaluation(
        evaluation_interval=1000,
        evaluation_duration=STEPS,
        evaluation_duration_unit="timesteps",
        evaluation_config={"explore": False, "input_": "sampler"},
    )
    return config


def ppo(env: str, *, model: Any = None, training: Any = None, **more: Any) -> Any:
    config = old(PPOConfig(), env, **more).env_runners(rollout_fragment_length=64)
    config.training(train_batch_size=64, minibatch_size=64, num_epochs=1, **(training or {}))
    return config.training(model={"fcnet_hiddens": [16, 16], **(model or {})})


def toy(kind: str, **more: Any) -> Any:
    return ppo("old_toy", kind=kind, **more)


def user_model(model: Any) -> Any:
    return ppo("CartPole-v1", model={"custom_model": model})


def make_replay_buffer(self: Any, config: Any) -> Any:
    return from_config(ReplayBuffer, config["replay_buffer_config"])


# DQN's validation turns the buffer's name into a class, in which ray 2.60 then looks for a word (TypeError).
DQN._create_local_replay_buffer_if_necessary = make_replay_buffer


def dqn(**training: Any) -> Any:
    config = old(DQNConfig(), "CartPole-v1")
    config.env_runners(rollout_fragment_length=4)
    config.training(num_steps_sampled_before_learning_starts=4, train_batch_size=8, **training)
    config.reporting(min_sample_timesteps_per_iteration=8)
    return config.training(model={"fcnet_hiddens": [16]}, replay_buffer_config=dict(REPLAY))


def sac(env: str, **more: Any) -> Any:
    config = old(SACConfig(), env, **more).env_runners(rollout_fragment_length=4)
    small = {"fcnet_hiddens": [16], "fcnet_activation": "relu"}
    config.training(num_steps_sampled_before_learning_starts=4, train_batch_size=8, policy_model_config=small)
    config.reporting(min_sample_timesteps_per_iteration=8)
    return config.training(q_model_config=small, replay_buffer_config=dict(REPLAY))


def parallel(config: Any) -> Any:
    old(config, "CartPole-v1", filtered="MeanStdFilter").env_runners(rollout_fragment_length=32)
    return config.training(train_batch_size=64, model={"fcnet_hiddens": [16]}).resources(num_gpus=0)


def offline(config: Any, recorded: str, env: str, **training: Any) -> Any:
    old(config, env).offline_data(input_=recorded)
    return config.training(train_batch_size=64, model={"fcnet_hiddens": [16]}, **training)


def several() -> Any:
    spaces = old_zoo_parts.SPACES
    policies = {
        "arm": PolicySpec(None, *spaces["mixed"], {}),
        "cart": PolicySpec(None, *spaces["started"], {"model": {"fcnet_hiddens": [8]}}),
    }
    return ppo("old_pair").multi_agent(policies=policies, policy_mapping_fn=lambda agent, *_, **__: agent)


def own_policy() -> Any:
    policy = {"default_policy": PolicySpec(old_zoo_parts.OldOwnPolicy, *old_zoo_parts.SPACES["mixed"], {})}
    return toy("mixed").multi_agent(policies=policy, policy_mapping_fn=lambda *_, **__: "default_policy")


def configurations(out: Path) -> dict[str, Any]:
    continuous, discrete = (str(out / f"data_{name}") for name in ("continuous", "discrete"))
    clip = {"normalize_actions": False, "clip_actions": True}
    lstm = {"fcnet_hiddens": [8], "use_lstm": True, "lstm_cell_size": 8, "max_seq_len": 4}
    attention = {"fcnet_hiddens": [8], "use_attention": True, "attention_dim": 8, "attention_num_transformer_units": 1}
    picture = {"conv_filters": [[4, [3, 3], 2], [8, [5, 5], 1]], "fcnet_hiddens": []}
    return {
        "pendulum": ppo("Pendulum-v1", filtered="MeanStdFilter").offline_data(
            output=continuous, output_write_episodes=False
        ),
        "cart_pole": ppo("CartPole-v1").offline_data(output=discrete, output_write_episodes=False),
        "clipped": ppo("Pendulum-v1", **clip),
        "shared": ppo("Pendulum-v1", model={"vf_share_layers": True, "fcnet_activation": "relu"}),
        "free_std": ppo("Pendulum-v1", model={"free_log_std": True}),
        "no_critic": ppo("CartPole-v1", training={"use_critic": False, "use_gae": False}).env_runners(
            batch_mode="complete_episodes"
        ),
        "concurrent": ppo("Pendulum-v1", filtered="ConcurrentMeanStdFilter"),
        "unbounded": toy("unbounded", filtered="MeanStdFilter"),
        "half_bounded": toy("half_bounded", clip_actions=True),
        "mixed": toy("mixed"),
        "double": toy("double", filtered="MeanStdFilter"),
        "started": toy("started"),
        "grid": toy("grid", filtered="MeanStdFilter"),
        "beams": toy("beams"),
        "filtered_beams": toy("beams", filtered="MeanStdFilter"),
        "picture": toy("picture", model=picture),
        "offset": toy("offset", filtered="MeanStdFilter"),
        "dqn": dqn(),
        "plain_dqn": dqn(dueling=False, double_q=False, hiddens=[], categorical_distribution_temperature=0.5),
        "distributional_dqn": dqn(num_atoms=5, v_min=-2.0, v_max=30.0),
        "noisy_dqn": dqn(noisy=True),
        # Evaluation by steps cuts episodes, which this exploration does not take.
        "noisy_weights": dqn()
        .evaluation(evaluation_duration_unit="episodes", evaluation_duration=1)
        .env_runners(
            batch_mode="complete_episodes",
            exploration_config={"type": "ParameterNoise", "sub_exploration": {"type": "EpsilonGreedy"}},
        ),
        "sac": sac("Pendulum-v1", filtered="MeanStdFilter"),
        "unnormalized_sac": sac("Pendulum-v1", **clip),
        "discrete_sac": sac("CartPole-v1"),
        "appo": parallel(APPOConfig()),
        "impala": parallel(IMPALAConfig()),
        "marwil": offline(MARWILConfig(), continuous, "Pendulum-v1"),
        # RLlib's own BC cannot train on the old stack of ray 2.60 (its training_step raises TypeError); MARWIL with
        # beta=0 is the same policy and the same loss.
        "cloned": offline(MARWILConfig(), discrete, "CartPole-v1", beta=0.0),
        "cql": offline(CQLConfig(), continuous, "Pendulum-v1"),
        "user_model": user_model(old_zoo_parts.OldModel),
        "bearing": user_model(old_zoo_parts.OldBearing),
        "named_model": user_model("named_model"),
        "batch_reader": user_model(old_zoo_parts.OldBatchReader),
        "previous_action": user_model(old_zoo_parts.OldPreviousAction),
        "clock_reader": user_model(old_zoo_parts.OldClockReader),
        "lstm": ppo("CartPole-v1", model=lstm),
        "attention": ppo("CartPole-v1", model=attention),
        "continuous_lstm": ppo("Pendulum-v1", filtered="MeanStdFilter", model={**lstm, "vf_share_layers": True}),
        "previous_lstm": ppo("Pendulum-v1", model={**lstm, "lstm_use_prev_action": True}),
        "user_recurrent": ppo("CartPole-v1", model={"custom_model": old_zoo_parts.OldRecurrent, "max_seq_len": 4}),
        "choice": toy("choice"),
        "shifted": toy("shifted", filtered="MeanStdFilter"),
        "dials": toy("dials"),
        "gauge": toy("gauge"),
        "nested": toy("nested"),
        "filtered_nested": toy("nested", filtered="MeanStdFilter"),
        "camera": toy("camera", model=picture),
        "levers": toy("levers"),
        "counts": toy("counts"),
        "limbs": toy("limbs"),
        "clipped_limbs": toy("limbs", clip_actions=True),
        "masked": toy("masked", model={"custom_model": TorchActionMaskModel}),
        "named_distribution": toy("mixed", model={"custom_action_dist": "tanh_gaussian"}),
        "tempered": toy("grid", model={"custom_action_dist": "tempered"}),
        "own_policy": own_policy(),
        "several": several(),
    }


def record(algorithm: Any) -> dict[str, dict[str, Any]]:
    """Let RLlib evaluate by itself and return what went in and out of the environment, by agent."""
    worker = algorithm.eval_env_runner_group.local_env_runner
    # RLlib hands the filters to remote evaluation workers only (`FilterManager.synchronize`, ray 2.60).
    worker.sync_filters(algorithm.env_runner.get_filters())
    worker.foreach_policy(lambda policy, _: policy.agent_connectors.in_eval())
    env = worker.async_env.get_sub_environments()[0]
    seen: dict[str, list[dict[str, Any]]] = {}
    last: dict[str, Any] = {}
    real_reset, real_step = env.reset, env.step

    def by_agent(value: Any) -> Any:
        return value if isinstance(env, old_zoo_parts.OldPair) else {"agent": value}

    def reset(**kwargs: Any) -> Any:
        obs, info = real_reset(**kwargs)
        last.update(obs=by_agent(obs), restart=True)
        return obs, info

    def step(action: Any) -> Any:
        for agent, one in by_agent(action).items():
            if last:
                named = {**leaves(last["obs"][agent], "obs"), **leaves(one, "action")}
                seen.setdefault(agent, []).append({**named, "restart": last["restart"]})
        result = real_step(action)
        last.update(obs=by_agent(result[0]), restart=False)
        return result

    env.reset, env.step = reset, step
    algorithm.evaluate()
    assert all(len(steps) >= STEPS * 0.8 for steps in seen.values()) and seen
    return {agent: {name: np.stack([one[name] for one in steps]) for name in steps[0]} for agent, steps in seen.items()}


def chosen(out: Path, only: list[str]) -> Iterator[tuple[str, Any]]:
    for name, config in configurations(out).items():
        if not only or name in only:
            yield name, config


def main(out: Path, only: list[str]) -> None:
    tune.register_env("old_toy", old_zoo_parts.OldToy)
    tune.register_env("old_pair", old_zoo_parts.OldPair)
    old_zoo_registry.register()
    with ray_for_training():
        for name, config in chosen(out, only):
            algorithm = config.build_algo()
            algorithm.train()
            algorithm.save(str(out / name))
            if name not in REFUSED:
                for agent, pairs in record(algorithm).items():
                    np.savez(out / f"{name if agent == 'agent' else f'{name}_{agent}'}.npz", **pairs)
            algorithm.stop()
            print(name, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
