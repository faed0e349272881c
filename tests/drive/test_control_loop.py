"""The closed loop over real Gymnasium environments, with policies small enough to read here."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import register, registry
from numpy.typing import NDArray
from rich.console import Console
from typing_extensions import Self

from rlservo.bundle.contract import Contract, Evaluation, Parity, Provenance, TensorSpec
from rlservo.bundle.spaces import BoxSpec, DictSpec, DiscreteSpec, Element
from rlservo.drive.control_loop import rollout
from rlservo.drive.environment_fit import check_fit
from rlservo.drive.report import latency_of, render_report
from rlservo.drive.success import success_of, wilson_interval
from rlservo.errors import UnavailableError, UsageError

Decide = Callable[[NDArray[Any]], Any]


class WrittenPolicy:
    """An ActingPolicy whose action is an ordinary function of the observation."""

    def __init__(self, contract: Contract, decide: Decide) -> None:
        self._contract = contract
        self.decide = decide
        self.calls = 0
        self.seeds: list[int | None] = []
        self.resets = 0

    @property
    def contract(self) -> Contract:
        return self._contract

    def act(self, obs: Any, *, explore: bool = False, seed: int | None = None) -> NDArray[Any]:
        self.calls += 1
        if explore:
            self.seeds.append(seed)
        space = self._contract.action_space
        return np.asarray(self.decide(np.asarray(obs)), dtype=space.dtype).reshape(space.shape)

    def reset(self) -> None:
        self.resets += 1

    def close(self) -> None:
        raise AssertionError("a rollout must not close a policy that it was given")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...


def contract_of(observation: BoxSpec, action: BoxSpec | DiscreteSpec, rate_hz: float | None = None) -> Contract:
    return Contract(
        name="written",
        version="1",
        observation_space=observation,
        action_space=action,
        inputs=(TensorSpec(name="obs", dtype="float32", shape=(-1, *observation.shape)),),
        outputs=(TensorSpec(name="action", dtype=action.dtype, shape=(-1, *action.shape)),),
        distribution=None,
        baked_in=(),
        control_rate_hz=rate_hz,
        provenance=Provenance(
            algorithm="none",
            api_stack="new",
            module_id="written",
            module_class="WrittenPolicy",
            checkpoint_sha256="0" * 64,
            ray_version="none",
            torch_version="none",
            rlservo_version="0.1.0",
            exported_at="2026-01-01T00:00:00Z",
        ),
        parity=Parity(reference="none", samples=0, batch_sizes=(), rtol=0, atol=0, formats={}),
    )


PENDULUM_OBS = BoxSpec(shape=(3,), dtype="float32", low=(-1.0, -1.0, -8.0), high=(1.0, 1.0, 8.0))
PENDULUM_ACTION = BoxSpec(shape=(1,), dtype="float32", low=-2.0, high=2.0)


def damp(obs: NDArray[Any]) -> NDArray[Any]:
    return np.clip(-obs[2:], -2.0, 2.0)


def pendulum_policy(decide: Decide = damp, rate_hz: float | None = 20.0) -> WrittenPolicy:
    return WrittenPolicy(contract_of(PENDULUM_OBS, PENDULUM_ACTION, rate_hz), decide)


class Corridor(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Walk from 0 to 1; five steps at most. It can draw itself without any GL, and says when it is closed."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012
    open_ones = 0

    def __init__(
        self, render_mode: str | None = None, speak: bool = True, break_at: int = 99, is_real: bool = False
    ) -> None:
        self.render_mode, self.speak, self.break_at, self.is_real = render_mode, speak, break_at, is_real
        self.observation_space = gym.spaces.Box(-10, 10, (1,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        Corridor.open_ones += 1

    @classmethod
    def describe(cls, **_: Any) -> dict[str, Any]:
        named = {"name": "x", "unit": "m"}
        return {"observation": [named], "action": [{"name": "step", "unit": "m"}], "control_rate_hz": 50.0}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.steps = 0.0, 0
        return np.zeros(1, np.float32), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        if self.steps == self.break_at:
            raise ValueError("the floor gave way")
        self.x += float(action[0])
        self.steps += 1
        arrived, out = self.x >= 1.0, self.steps >= 5
        status = {"final_status": "success" if arrived else "max_steps_exceeded"} if arrived or out else {}
        return np.full(1, self.x, np.float32), -1.0, arrived, out, status if self.speak else {}

    def render(self) -> NDArray[np.uint8]:
        picture = np.zeros((48, 64, 3), np.uint8)
        picture[:, : int(64 * min(self.x, 1.0))] = 255
        return picture

    def close(self) -> None:
        Corridor.open_ones -= 1


@pytest.fixture(autouse=True)
def corridor() -> Iterator[None]:
    register(id="rollout-tests/Corridor-v0", entry_point=Corridor)
    Corridor.open_ones = 0
    yield
    del registry["rollout-tests/Corridor-v0"]
    assert Corridor.open_ones == 0, "a rollout left its environment open"


CORRIDOR = "rollout-tests/Corridor-v0"


def corridor_policy(step: float | Decide = 0.5, **action: Any) -> WrittenPolicy:
    obs = BoxSpec(shape=(1,), dtype="float32", low=-10.0, high=10.0)
    space = BoxSpec(**{"shape": (1,), "dtype": "float32", "low": -1.0, "high": 1.0, **action})
    return WrittenPolicy(contract_of(obs, space), step if callable(step) else lambda _: step)


def test_the_same_seed_gives_the_same_returns() -> None:
    first = rollout(pendulum_policy(), "Pendulum-v1", episodes=3, seed=5)
    again = rollout(pendulum_policy(), "Pendulum-v1", episodes=3, seed=5)
    assert [row.episode_return for row in first.episodes] == [row.episode_return for row in again.episodes]
    assert len({row.episode_return for row in first.episodes}) == 3


def test_episode_i_is_reset_with_seed_plus_i() -> None:
    together = rollout(pendulum_policy(), "Pendulum-v1", episodes=3, seed=5)
    alone = rollout(pendulum_policy(), "Pendulum-v1", episodes=1, seed=7)
    assert [row.seed for row in together.episodes] == [5, 6, 7]
    assert together.episodes[2].episode_return == alone.episodes[0].episode_return


def test_the_return_is_what_a_hand_written_loop_gets() -> None:
    env = gym.make("Pendulum-v1")
    obs, _ = env.reset(seed=11)
    expected, ended = 0.0, False
    while not ended:
        obs, reward, terminated, truncated, _ = env.step(damp(obs).astype(np.float32))
        expected, ended = expected + float(reward), terminated or truncated
    env.close()
    report = rollout(pendulum_policy(), "Pendulum-v1", episodes=1, seed=11)
    assert report.return_mean == pytest.approx(expected, abs=1e-9)
    assert (report.steps, report.length_mean, report.return_std) == (200, 200.0, None)


def test_discrete_actions_reach_the_environment_as_integers() -> None:
    low, high = (-4.8, None, -0.41887903, None), (4.8, None, 0.41887903, None)
    contract = contract_of(BoxSpec(shape=(4,), dtype="float32", low=low, high=high), DiscreteSpec(n=2))
    report = rollout(WrittenPolicy(contract, lambda obs: int(obs[2] > 0)), "CartPole-v1", episodes=2, seed=1)
    assert report.return_mean == report.length_mean
    assert report.success_rate is None and report.success_interval is None


def test_success_and_endings_are_counted_from_final_status() -> None:
    report = rollout(corridor_policy(0.5), CORRIDOR, episodes=4)
    assert (report.successes, report.success_rate, report.length_mean) == (4, 1.0, 2.0)
    assert report.final_status == {"success": 4}
    assert report.success_interval == pytest.approx((0.5101, 1.0), abs=1e-3)
    failed = rollout(corridor_policy(0.1), CORRIDOR, episodes=2)
    assert (failed.successes, failed.success_rate) == (0, 0.0)
    assert failed.final_status == {"max_steps_exceeded": 2}


def test_an_environment_that_says_nothing_of_success_gives_none() -> None:
    report = rollout(corridor_policy(), CORRIDOR, episodes=2, env_kwargs={"speak": False})
    assert (report.successes, report.success_rate, report.success_interval) == (None, None, None)
    assert success_of({"is_success": np.bool_(False), "final_status": "success"}) is False


@pytest.mark.parametrize("said", [0.0, np.float32(1.0), np.array([False]), np.array(1)])
def test_a_success_is_true_or_false_also_as_a_number(said: Any) -> None:
    assert success_of({"success": said}) is bool(np.asarray(said).item())


@pytest.mark.parametrize("said", ["False", 0.5, float("nan"), np.array([True, False]), {"reached": False}])
def test_a_success_that_is_neither_true_nor_false_is_refused(said: Any) -> None:
    with pytest.raises(UsageError, match=r"^the environment's info\['success'\] is .*: expected true or false$"):
        success_of({"success": said})


def test_the_policy_is_reset_at_every_episode() -> None:
    policy = corridor_policy()
    rollout(policy, CORRIDOR, episodes=3)
    assert policy.resets == 3


def test_exploring_draws_follow_from_the_seed() -> None:
    first, again, other = corridor_policy(), corridor_policy(), corridor_policy()
    rollout(first, CORRIDOR, episodes=2, seed=3, explore=True)
    rollout(again, CORRIDOR, episodes=2, seed=3, explore=True)
    rollout(other, CORRIDOR, episodes=2, seed=30, explore=True)
    assert first.seeds == again.seeds != other.seeds
    assert len(set(first.seeds)) == 4


def test_rate_real_keeps_the_control_rate() -> None:
    report = rollout(corridor_policy(0.2), CORRIDOR, episodes=4, rate="real")
    assert report.control_rate_hz == 50.0
    # Five steps are four waits of 20 ms; a busy machine may take longer, but never less.
    assert report.wall_s >= 4 * 4 * 0.02 - 0.001
    assert report.overruns is not None


def test_rate_real_counts_a_late_loop_and_skips_the_periods_it_missed() -> None:
    def slow_once(obs: NDArray[Any]) -> float:
        if obs[0] == 0.0:
            time.sleep(0.05)  # two and a half periods
        return 0.2

    began = time.perf_counter()
    report = rollout(corridor_policy(slow_once), CORRIDOR, episodes=1, rate="real")
    # Due at 0, 20, 40, 60 ms ...: the second step runs late at 50, the next ones at 60, 80 and 100 without a burst.
    assert time.perf_counter() - began >= 0.1 - 0.001
    assert report.overruns is not None and report.overruns >= 1
    assert rollout(corridor_policy(), CORRIDOR, episodes=1).overruns is None


def test_deadline_misses_are_the_answers_slower_than_a_control_period() -> None:
    def sometimes_slow(obs: NDArray[Any]) -> float:
        if obs[0] >= 0.3:
            time.sleep(0.03)  # a period is 20 ms
        return 0.2

    report = rollout(corridor_policy(sometimes_slow), CORRIDOR, episodes=2)
    assert report.deadline_ms == 20.0
    assert report.deadline_misses is not None and report.deadline_misses >= 2 * 3  # at 0.4, 0.6 and 0.8
    assert report.latency_ms is not None and report.latency_ms.max >= 30.0


def test_the_control_rate_comes_from_the_environment_then_the_contract_then_render_fps() -> None:
    assert rollout(corridor_policy(), CORRIDOR, episodes=1).control_rate_hz == 50.0
    assert rollout(pendulum_policy(rate_hz=20.0), "Pendulum-v1", episodes=1).control_rate_hz == 20.0
    assert rollout(pendulum_policy(rate_hz=None), "Pendulum-v1", episodes=1).control_rate_hz == 30.0


def test_ctrl_c_returns_what_was_finished() -> None:
    policy = corridor_policy()

    def stop_in_the_third(_: NDArray[Any]) -> float:
        if policy.resets == 3:
            raise KeyboardInterrupt
        return 0.5

    policy.decide = stop_in_the_third
    report = rollout(policy, CORRIDOR, episodes=10)
    assert (report.interrupted, len(report.episodes), report.requested_episodes) == (True, 2, 10)
    assert report.success_rate == 1.0


def test_ctrl_c_before_the_first_episode_ends_reports_nothing_instead_of_failing() -> None:
    def stop(_: NDArray[Any]) -> float:
        raise KeyboardInterrupt

    report = rollout(corridor_policy(stop), CORRIDOR, episodes=10)
    assert (report.interrupted, report.episodes, report.return_mean, report.latency_ms) == (True, (), None, None)
    render_report(report)


def test_a_policy_error_names_the_episode_and_step() -> None:
    policy = corridor_policy()

    def unplugged(obs: NDArray[Any]) -> float:
        if policy.resets == 2 and obs[0] > 0:
            raise UnavailableError("the server is gone", {"url": "http://somewhere"})
        return 0.5

    policy.decide = unplugged
    with pytest.raises(UnavailableError, match=r"^episode 1, step 1: the server is gone$") as caught:
        rollout(policy, CORRIDOR, episodes=3)
    assert caught.value.details == {"url": "http://somewhere"}


def test_an_environment_error_names_the_episode_and_step() -> None:
    with pytest.raises(UsageError, match="episode 0, step 1: the environment failed with ValueError: the floor gave"):
        rollout(corridor_policy(), CORRIDOR, episodes=1, env_kwargs={"break_at": 1})


def test_on_episode_sees_each_row_as_it_comes() -> None:
    seen: list[int] = []
    rollout(corridor_policy(), CORRIDOR, episodes=3, on_episode=lambda row: seen.append(row.index))
    assert seen == [0, 1, 2]


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        ({"shape": (2,)}, r"the action has shape \(1,\) there, but the policy has \(2,\)"),
        ({"high": 2.0}, "the action element 0 has high 1 there, but the policy has 2"),
        ({"low": None}, "the action element 0 has low -1 there, but the policy has -inf"),
        ({"dtype": "int64"}, "the action has dtype float32 there, but the policy has int64"),
        ({"elements": ({"name": "torque"},)}, "the action element 0 is 'step' there, but the policy has 'torque'"),
    ],
)
def test_an_action_space_that_differs_is_refused_in_one_sentence(action: dict[str, Any], sentence: str) -> None:
    policy = corridor_policy(**action)
    with pytest.raises(UsageError, match=f"policy 'written' does not fit {CORRIDOR}: {sentence}"):
        rollout(policy, CORRIDOR, episodes=1)
    assert policy.calls == 0


def test_an_observation_space_that_differs_is_refused() -> None:
    with pytest.raises(UsageError, match=r"the observation has shape \(4,\) there, but the policy has \(3,\)"):
        rollout(pendulum_policy(), "CartPole-v1", episodes=1)
    contract = contract_of(BoxSpec(shape=(1,), dtype="float32", low=-10.0, high=10.0), DiscreteSpec(n=3))
    with pytest.raises(UsageError, match=r"the action is a Box there, but the policy has Discrete\(3\)"):
        rollout(WrittenPolicy(contract, lambda _: 0), CORRIDOR, episodes=1)


class Parts(Corridor):
    """A corridor whose observation is a Dict, described by a dict of lists."""

    observation_space = gym.spaces.Dict({"walker": gym.spaces.Box(-10, 10, (1,), np.float32)})

    def __init__(self, **_: Any) -> None:
        super().__init__()
        self.observation_space = Parts.observation_space

    @classmethod
    def describe(cls, **_: Any) -> dict[str, Any]:
        return {**super().describe(), "observation": {"walker": [{"name": "x", "unit": "m"}]}}


@pytest.mark.parametrize("unit", ["m", "mm"])
def test_a_described_dict_is_compared_part_by_part(unit: str, caplog: pytest.LogCaptureFixture) -> None:
    leaf = BoxSpec(shape=(1,), dtype="float32", low=-10, high=10, elements=(Element(name="x", unit=unit),))
    spec = DictSpec(spaces={"walker": leaf})
    contract = corridor_policy().contract.model_copy(update={"observation_space": spec})
    env = Parts()
    if unit == "m":
        check_fit(contract, env, {})
    else:
        with pytest.raises(UsageError, match=r"part walker element 0 \(x\) has unit m there, but the policy has mm"):
            check_fit(contract, env, {})
    env.close()
    assert not caplog.records  # "describe() is not used"


def test_an_unknown_environment_is_named_with_its_close_matches() -> None:
    with pytest.raises(UsageError, match=r"'Pendulun-v1' is not registered: did you mean Pendulum-v1") as caught:
        rollout(pendulum_policy(), "Pendulun-v1", episodes=1)
    assert "Pendulum-v1" in caught.value.details["close_matches"]
    assert "Your own is 'module:Pendulun-v1'" in str(caught.value)


def test_a_module_that_is_elsewhere_asks_for_its_folder() -> None:
    with pytest.raises(UsageError, match=r"cannot be made: No module named 'crane': install it, or name its folder"):
        rollout(corridor_policy(), "crane:Crane-v0", episodes=1)


def test_wrong_constructor_arguments_are_a_usage_error() -> None:
    with pytest.raises(UsageError, match=r"cannot be made with .*unexpected keyword argument 'colour'$"):
        rollout(corridor_policy(), CORRIDOR, episodes=1, env_kwargs={"colour": "red"})


def evaluated(disturbance: str | None, successes: int | None, episodes: int = 100) -> Evaluation:
    return Evaluation(
        env_id=CORRIDOR, episodes=episodes, first_seed=0, return_bundle=0.0, disturbance=disturbance,
        success_rate_bundle=None if successes is None else successes / episodes,
        success_interval=None if successes is None else wilson_interval(successes, episodes), evaluated_at="2026-01-01",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("evaluation", "sentence"),
    [
        (evaluated(None, 100), "was never evaluated under latency"),
        (evaluated("none", 100), "was never evaluated under latency"),
        (evaluated("observation_latency=2", 100), "was never evaluated under latency"),
        (evaluated("latency=0..3", 100), "was never evaluated under latency"),
        (evaluated("latency=3,noise=real", 70), r"too rarely.*\(latency=3,noise=real: 70% of 100 episodes\)"),
        (evaluated("latency=3", 5, episodes=5), r"too few episodes.*\(latency=3: 100% of 5 episodes\)"),
        (evaluated("latency=3", None), r"too rarely.*\(latency=3: no success rate of 100 episodes\)"),
        (evaluated("latency=3", 95), None),
    ],
)
def test_a_real_robot_takes_a_policy_that_succeeds_under_latency_often_enough(
    evaluation: Evaluation, sentence: str | None
) -> None:
    contract = corridor_policy().contract.model_copy(update={"evaluations": (evaluation,)})
    policy = WrittenPolicy(contract, lambda _: 0.5)
    options: dict[str, Any] = {"episodes": 1, "env_kwargs": {"is_real": True}}
    if sentence is not None:
        with pytest.raises(UsageError, match=sentence):
            rollout(policy, CORRIDOR, **options)
        options["unproven"] = True
    assert rollout(policy, CORRIDOR, **options).successes == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"episodes": 0}, "episodes must be 1 or more, got 0"),
        ({"episodes": 1, "seed": -1}, "seed must be 0 or more, got -1"),
        ({"episodes": 1, "rate": "fast"}, "rate 'fast' does not exist"),
        ({"episodes": 1, "video": "film.gif"}, "expected a name that ends in .mp4"),
        ({"episodes": 1, "video": "nowhere/film.mp4"}, "folder 'nowhere' does not exist"),
        ({"episodes": 1, "video": "film.mp4", "video_episodes": 0}, "video_episodes must be 1 or more"),
    ],
)
def test_arguments_out_of_range_are_refused(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        rollout(corridor_policy(), CORRIDOR, **arguments)


def test_the_report_is_json_and_a_table() -> None:
    report = rollout(corridor_policy(), CORRIDOR, episodes=2, seed=1, rate="real")
    document = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert document["episodes"][1]["seed"] == 2
    assert document["latency_ms"]["p50"] <= document["latency_ms"]["p99"]
    console = Console(width=120, record=True, file=open(os.devnull, "w"))  # noqa: PTH123, SIM115
    with console.file:
        console.print(render_report(report))
    text = console.export_text()
    for word in ("2 of 2", "100.0%", "success: 2", "p99", "50 Hz", "overruns"):
        assert word in text


def test_wilson_interval_agrees_with_the_published_example() -> None:
    # 15 of 148 with 95%: 6.2% to 16.1% (R. G. Newcombe, Statistics in Medicine 17, 1998, table I, method 3).
    low, high = wilson_interval(15, 148)
    assert (low, high) == pytest.approx((0.0624, 0.1605), abs=1e-4)
    assert wilson_interval(0, 20)[0] == 0.0 and wilson_interval(20, 20)[1] == pytest.approx(1.0)


def test_latency_percentiles_are_milliseconds() -> None:
    latency = latency_of([i / 1000 for i in range(101)])
    assert latency is not None
    assert (latency.p50, latency.p95, latency.p99, latency.max) == pytest.approx((50, 95, 99, 100))


def decode(file: Path, *, width: int, height: int) -> tuple[NDArray[np.uint8], str]:
    """Return every frame, (n, height, width, 3), and what ffmpeg says of the file."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(file), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3), done.stderr.decode()


def test_the_video_holds_every_frame_of_the_first_episode_at_the_control_rate(tmp_path: Path) -> None:
    file = tmp_path / "walk.mp4"
    report = rollout(corridor_policy(0.25), CORRIDOR, episodes=3, video=file)
    assert report.video == str(file)
    frames, log = decode(file, width=64, height=48)
    assert " 50 fps" in log
    assert len(frames) == 5  # the first observation and four steps; the other two episodes are not filmed
    assert frames[0].shape == (48, 64, 3)
    brightness = [float(frame.mean()) for frame in frames]
    assert brightness[0] < 10 and brightness[-1] > 245 and brightness == sorted(brightness)


def test_an_environment_that_cannot_draw_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_gl(self: Corridor) -> NDArray[np.uint8]:
        raise RuntimeError("gladLoadGL error")

    monkeypatch.setattr(Corridor, "render", no_gl)
    with pytest.raises(UsageError, match=r"gladLoadGL error.*libegl1 and set MUJOCO_GL=egl, or libosmesa6"):
        rollout(corridor_policy(), CORRIDOR, episodes=1, video=tmp_path / "film.mp4")
    assert not (tmp_path / "film.mp4").exists()


def test_a_mujoco_simulator_is_filmed_where_the_machine_can_draw(tmp_path: Path) -> None:
    # In a process of its own: MuJoCo settles how it draws when it is imported, and other tests may have done that.
    file = tmp_path / "arm.mp4"
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import numpy as np
from test_control_loop import WrittenPolicy, contract_of
from rlservo.bundle.spaces import BoxSpec
from rlservo.drive.control_loop import rollout
from rlservo.drive.environment_fit import check_fit
obs = BoxSpec(shape=(27,), dtype="float32", low=None, high=None)
action = BoxSpec(shape=(5,), dtype="float32", low=-1.0, high=1.0)
def five_steps(obs):  # a frame takes a quarter of a second without a graphics card
    if policy.calls > 5:
        raise KeyboardInterrupt
    return obs[3:8] * 0.9
policy = WrittenPolicy(contract_of(obs, action), five_steps)
report = rollout(
    policy, "rlservo/EndEffectorPositioningURSim-v0", episodes=1, seed=1, video={str(file)!r},
)
print(report.steps, report.interrupted, report.control_rate_hz)
"""
    environment = {**os.environ}
    environment.setdefault("MUJOCO_GL", "egl")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    if "cannot draw a picture" in done.stderr:
        assert "libegl1" in done.stderr
        pytest.skip("this machine has no GL library to draw with (Debian: libegl1)")
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["5", "True", "10.0"]
    frames, log = decode(file, width=640, height=480)
    assert " 10 fps" in log
    assert len(frames) == 6  # an interrupted video is still a whole file
    assert frames.std() > 10  # a picture, not a black film
