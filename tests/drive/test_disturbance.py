"""Rollouts under disturbances: what is parsed, refused and measured, with an environment small enough to read here."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import register, registry
from numpy.typing import NDArray
from rich.console import Console

from rlservo.bundle.contract import Contract, Parity, Provenance, TensorSpec
from rlservo.bundle.spaces import BoxSpec, SpaceSpec
from rlservo.drive.control_loop import rollout
from rlservo.drive.disturbance import parse_disturbance
from rlservo.drive.disturbance_table import (
    DisturbanceTable,
    check_plot,
    evaluations_of,
    measure_disturbances,
    plot_table,
    render_table,
)
from rlservo.drive.report import render_report
from rlservo.drive.smoothness import StepSize
from rlservo.errors import UsageError

ENV = "rollout-tests/Track-v0"
UR, MIR = "rlservo/EndEffectorPositioningURSim-v0", "rlservo/NoObstacleNavigationMir100Sim-v0"


class Track(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Stay within 1 m of 0 while a push of 0.1 m a step has to be countered; twenty steps."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-10, 10, (2,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.x, self.steps, self.speed = 0.0, 0, 0.0

    @classmethod
    def describe(cls, **_: Any) -> dict[str, Any]:
        names = [{"name": "x", "unit": "m"}, {"name": "speed", "unit": "m/s"}]
        return {"observation": names, "action": [{"name": "speed", "unit": "m/s"}], "control_rate_hz": 10.0}

    @property
    def commanded_velocity(self) -> dict[str, NDArray[np.float64]]:
        return {"m/s": np.array([self.speed])}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.steps, self.speed = float(self.np_random.uniform(-0.5, 0.5)), 0, 0.0
        return np.array([self.x, 0.0], np.float32), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        self.speed = float(action[0])
        self.x += self.speed + 0.1
        self.steps += 1
        lost, over = abs(self.x) > 1.0, self.steps == 20
        status = {"final_status": "off the track" if lost else "success"} if lost or over else {}
        return np.array([self.x, self.speed], np.float32), 1.0, lost, over and not lost, status


@pytest.fixture(autouse=True)
def track() -> Iterator[None]:
    register(id=ENV, entry_point=Track)
    yield
    del registry[ENV]


class Steering:
    """An `ActingPolicy` that brings x back to 0 in one step."""

    def __init__(self, size: int = 2, actions: int = 1) -> None:
        observation = BoxSpec(shape=(size,), dtype="float32", low=-10.0, high=10.0)
        action: SpaceSpec = BoxSpec(shape=(actions,), dtype="float32", low=-1.0, high=1.0)
        self._actions = actions
        self.contract = Contract(
            name="steering",
            version="1",
            observation_space=observation,
            action_space=action,
            inputs=(TensorSpec(name="obs", dtype="float32", shape=(-1, size)),),
            outputs=(TensorSpec(name="action", dtype="float32", shape=(-1, actions)),),
            distribution=None,
            baked_in=(),
            provenance=Provenance(
                algorithm="none", api_stack="new", module_id="x", module_class="X", checkpoint_sha256="0" * 64,
                ray_version="none", torch_version="none", rlservo_version="0.1.0", exported_at="2026-01-01T00:00:00Z",
            ),
            parity=Parity(reference="none", samples=0, batch_sizes=(), rtol=0, atol=0, formats={}),
        )  # fmt: skip

    def act(self, obs: Any, **_: Any) -> NDArray[np.float32]:
        return np.full(self._actions, np.clip(-obs[0] - 0.1, -1.0, 1.0), np.float32)

    def reset(self) -> None: ...

    def close(self) -> None: ...

    def __enter__(self) -> Steering:
        return self

    def __exit__(self, *_: object) -> None: ...


def table(*rows: str, env_id: str = ENV, policy: Steering | None = None, episodes: int = 30) -> DisturbanceTable:
    return measure_disturbances(
        policy or Steering(), env_id, rows, episodes=episodes, seed=5, progress=lambda _line: None
    )


@pytest.mark.parametrize(
    ("text", "arguments"),
    [
        ("latency=3", {"action_latency": (3, 3)}),
        ("latency=0..3,late=2,drop=0.1", {
            "action_latency": (0, 3), "late_observations": (0, 2), "dropped_observations": (0.1, 0.1),
        }),
        ("noise=2*real, bias=real", {"observation_noise": "2*real", "observation_bias": "real"}),
        ("noise.x=0.1,noise.speed=1", {"observation_noise": {"x": 0.1, "speed": 1.0}}),
        ("payload=1..3,model=0.05,base=0.02", {"payload": (1, 3), "model_error": 0.05, "base_offset": (0.02, 0.02)}),
        ("target=outside,stuck=any", {"extreme": "target", "stuck_sensor": "any"}),
    ],
)  # fmt: skip
def test_kinds_and_sizes_are_arguments_of_the_randomisation(text: str, arguments: dict[str, Any]) -> None:
    assert parse_disturbance(text).arguments == arguments


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wind=3", "'wind=3': expected KIND=SIZE with one of latency, "),
        ("latency", "'latency': expected KIND=SIZE"),
        ("", "expected KIND=SIZE"),
        ("payload.x=3", "expected KIND=SIZE"),
        ("latency=1.5", "'latency=1.5': expected whole control cycles"),
        ("latency=-1", "expected a number, 0 to 1000"),
        ("noise=nan", "'noise=nan': expected real, 2*real or a number, 0 or more"),
        ("bias=real*2", "'bias=real*2': expected real, 2*real or a number"),
        ("noise=inf*real", "expected a number, 0 or more"),
        ("drop=1", "expected a number, 0 to less than 1"),
        ("payload=3..1", "expected LOW..HIGH with LOW not above HIGH"),
        ("payload=30", "expected a number, 0 to 20"),
        ("payload=1,payload=2", "payload is given twice"),
        ("noise=real,noise.x=1", "noise is given twice"),
        ("target=outside,start=corner", "target and start go one at a time"),
        ("start=middle", "expected start=corner"),
    ],
)
def test_what_is_no_disturbance_is_refused_in_one_sentence(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message.replace("*", r"\*").replace("..", r"\.\.")):
        rollout(Steering(), ENV, episodes=1, disturb=text)


@pytest.mark.parametrize(
    ("text", "lack"),
    [
        ("payload=1", "'payload=1': payload is (1.0, 1.0): Track has no simulation that carries one"),
        ("noise=real", "Track does not state its sensors' errors (sensor_errors)"),
        ("noise.z=1", "observation_noise names z: expected some of x, speed"),
        ("model=0.1", "no simulation with draw_model_error"),
        ("target=outside", "no extreme_options"),
    ],
)
def test_what_an_environment_lacks_is_named(text: str, lack: str) -> None:
    with pytest.raises(UsageError) as error:
        table("latency=1", text)
    assert lack in error.value.message


def test_latency_and_noise_by_name_make_success_fall_and_the_table_says_by_how_much() -> None:
    measured = table("latency=1", "latency=4", "noise.x=0.5", "drop=0.2")
    rows = {row.disturbance: row for row in measured.rows}
    assert list(rows) == ["none", "latency=1", "latency=4", "noise.x=0.5", "drop=0.2"]
    none, late = rows["none"], rows["latency=4"]
    assert (none.success_rate, none.successes, none.return_mean) == (1.0, 30, 20.0)
    assert none.success_interval is not None and none.success_interval[0] == pytest.approx(0.886, abs=1e-3)
    assert late.successes is not None and late.successes <= 3
    assert late.endings["off the track"] == 30 - late.successes
    assert late.return_interval is not None and late.return_interval[0] < late.return_mean < 20.0
    assert rows["noise.x=0.5"].success_rate is not None and rows["noise.x=0.5"].success_rate < 1.0
    assert measured == table("latency=1", "latency=4", "noise.x=0.5", "drop=0.2")  # by seed


def test_standard_rows_leave_out_what_the_environment_lacks_and_say_so() -> None:
    measured = table(episodes=2)
    names = [row.disturbance for row in measured.rows]
    assert names[:4] == ["none", "latency=1", "latency=3", "latency=5"]
    assert "latency=0..3,observation_latency=0..1,drop=0.05" in names and names[-1] == "stuck=any"
    assert "Track has no simulation that carries one" in measured.skipped["payload=3"]
    assert not set(names) & set(measured.skipped)


def test_steps_of_action_and_commanded_velocity_are_measured_from_rest() -> None:
    report = rollout(Steering(), ENV, episodes=1, seed=5)
    start = float(np.random.default_rng(5).uniform(-0.5, 0.5))
    first, later = -start - 0.1, -0.1  # to the middle, then against the push
    assert set(report.step_sizes) == {"action", "m/s"}
    assert report.step_sizes["action"].largest == pytest.approx(abs(first - later), abs=1e-6)
    assert report.step_sizes["action"].mean == pytest.approx(abs(first - later) / 19, abs=1e-6)
    assert report.step_sizes["m/s"].largest == pytest.approx(max(abs(first), abs(first - later)), abs=1e-6)
    late = rollout(Steering(), ENV, episodes=1, seed=5, disturb="latency=2")
    assert late.step_sizes["action"] != report.step_sizes["action"] and late.disturbance == "latency=2"
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(render_report(late))
    text = console.export_text()
    assert "latency=2" in text and "largest step" in text and "m/s" in text


def test_the_table_is_json_a_plot_and_evaluations(tmp_path: Path) -> None:
    measured = table("latency=4", episodes=3)
    assert json.loads(json.dumps(measured.as_dict()))["rows"][1]["disturbance"] == "latency=4"
    for out in (tmp_path / "table.png", tmp_path / "table.svg"):
        check_plot(out)
        plot_table(measured, out)
        assert out.stat().st_size > 2000
    for out, message in ((tmp_path / "table.xyz", "ends in"), (tmp_path / "no" / "table.png", "does not exist")):
        with pytest.raises(UsageError, match=message):
            check_plot(out)
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(render_table(measured))
    assert "3 off the track" in console.export_text()
    nominal, late = evaluations_of(measured, "2026-01-01T00:00:00+00:00")
    assert (nominal.disturbance, nominal.success_rate_bundle, nominal.return_checkpoint) == ("none", 1.0, None)
    assert late.endings == {"off the track": 3} and late.success_interval is not None


@pytest.mark.parametrize(("env_id", "size", "actions", "units"), [
    (UR, 27, 5, {"action", "rad/s"}), (MIR, 4, 2, {"action", "m/s", "rad/s"}),
])  # fmt: skip
def test_robots_are_disturbed_in_every_standard_way(env_id: str, size: int, actions: int, units: set[str]) -> None:
    policy = Steering(size, actions)
    policy.contract = policy.contract.model_copy(update={
        "observation_space": BoxSpec(shape=(size,), dtype="float32", low=None, high=None),
    })  # fmt: skip
    policy.act = lambda obs, **_: np.zeros(actions, np.float32)  # type: ignore[method-assign]
    limit = {"ur_model": "ur5"} if env_id == UR else {}
    report = rollout(
        policy, env_id, episodes=1, seed=0, env_kwargs=limit,
        disturb="latency=0..3,late=1,drop=0.1,noise=real,bias=real,stuck=any,model=0.05,base=0.01,target=outside"
        + (",payload=2" if env_id == UR else ""),
    )  # fmt: skip
    assert set(report.step_sizes) == units
    assert all(isinstance(size, StepSize) and size.largest >= size.mean >= 0 for size in report.step_sizes.values())
