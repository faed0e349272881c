"""The in-process runtime, against real bundles and a bare onnxruntime session."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from bundles import rewrite_contract, write_box_policy, write_discrete_policy
from rlservo.bundle.bundle import load_bundle, read_contract, write_contract, write_golden
from rlservo.bundle.contract import Contract, Distribution, StateSpec
from rlservo.errors import (
    ActionError,
    BundleError,
    BundleTamperedError,
    GoldenMismatchError,
    ObservationError,
    RequestError,
    UsageError,
)
from rlservo.policy.policy import Policy

OBS = np.linspace(-1, 1, 27, dtype=np.float32)


@pytest.fixture(scope="module")
def policy(ur5: Path) -> Policy:
    return Policy.load(ur5)


def test_act_returns_what_the_graph_computes(ur5: Path, policy: Policy) -> None:
    (expected,) = onnxruntime.InferenceSession(ur5 / "policy.onnx").run(["action"], {"obs": OBS[None]})
    action = policy.act(OBS)
    assert action.shape == (6,) and action.dtype == np.float32
    np.testing.assert_array_equal(action, expected[0])


@pytest.mark.parametrize("form", ["array", "float64", "list", "names", "integers"])
def test_every_form_of_an_observation_gives_the_same_action(policy: Policy, form: str) -> None:
    obs = np.round(OBS * 3)
    names = [element.name for element in policy.contract.observation_space.elements]
    forms = {
        "array": obs,
        "float64": obs.astype(np.float64),
        "list": obs.tolist(),
        "names": dict(zip(reversed(names), reversed(obs.tolist()), strict=True)),
        "integers": [int(value) for value in obs],
    }
    np.testing.assert_array_equal(policy.act(forms[form]), policy.act(obs))


def test_a_batch_gives_a_batch_whose_rows_are_the_single_actions(policy: Policy) -> None:
    batch = np.random.default_rng(0).standard_normal((50, 27)).astype(np.float32)
    actions = policy.act(batch)
    assert actions.shape == (50, 6)
    for obs, action in zip(batch, actions, strict=True):
        np.testing.assert_allclose(policy.act(obs), action, atol=1e-6)
    names = [element.name for element in policy.contract.observation_space.elements]
    np.testing.assert_array_equal(policy.act(dict(zip(names, batch.T.tolist(), strict=True))), actions)
    assert policy.act(batch[:1]).shape == (1, 6)


def test_a_discrete_policy_gives_integers_of_its_own_range(tmp_path: Path) -> None:
    policy = Policy.load(write_discrete_policy(tmp_path, start=3))
    assert policy.act(2).shape == () and policy.act(2).dtype == np.int64
    assert set(policy.act([0, 1, 2, 3, 4]).tolist()) <= {3, 4, 5}
    assert policy.act(2.0) == policy.act(np.int32(2)) == policy.act(2)
    for bad in (5, -1, 2.5, float("nan"), 1e30, "2", None, [], [[1]], 2**70):
        with pytest.raises(ObservationError):
            policy.act(bad)


@pytest.mark.parametrize(
    ("obs", "sentence"),
    [
        (OBS[:26], "policy 'ur5' expects obs of shape (27,), got (26,)"),
        (np.zeros((0, 27), np.float32), "empty batch"),
        (OBS[None, None], "a batch is of shape (B, 27)"),
        ([*OBS.tolist()[:3], float("nan"), *OBS.tolist()[4:]], "element 3 (element_3) is nan, not a finite number"),
        ([*OBS.tolist()[:26], float("inf")], "element 26 (element_26) is inf"),
        ([*OBS.tolist()[:26], 1e300], "element 26 (element_26) is 1e+300, too large for float32"),
        (
            [[*OBS.tolist()], [*OBS.tolist()[:5], float("nan"), *OBS.tolist()[6:]]],
            "(element_5) of observation 1 is nan",
        ),
        ([*OBS.tolist()[:26], "1.5"], "element 26 (element_26) is the string '1.5', not a number"),
        ([*OBS.tolist()[:26], None], "element 26 (element_26) is null"),
        ("obs", "the string 'obs'"),
        (None, "null"),
        ([[1.0], [1.0, 2.0]], "differ in length"),
        (dict.fromkeys([f"element_{i}" for i in range(26)], 0.0), "missing 'element_26'"),
        (dict.fromkeys([f"element_{i}" for i in range(28)], 0.0), "unknown 'element_27'"),
        (
            {**dict.fromkeys([f"element_{i}" for i in range(27)], 0.0), "element_4": "x"},
            "'element_4' is the string 'x'",
        ),
        (np.array(["1"] * 27), "the string '1'"),
        ([1j] * 27, "a complex"),
    ],
)
def test_a_wrong_observation_is_refused_with_a_sentence_that_names_it(
    policy: Policy, obs: object, sentence: str
) -> None:
    with pytest.raises(ObservationError) as caught:
        policy.act(obs)  # type: ignore[arg-type]
    assert sentence in caught.value.message


def test_large_finite_observations_are_not_mistaken_for_infinity(policy: Policy) -> None:
    assert np.isfinite(policy.act(np.full(27, 3e38, np.float32))).all()


def test_exploring_is_repeatable_by_seed_and_follows_the_distribution(ur5: Path, policy: Policy) -> None:
    first, again, other = (policy.act(OBS, explore=True, seed=seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    session = onnxruntime.InferenceSession(ur5 / "policy.onnx")
    (inputs,) = session.run(["action_dist_inputs"], {"obs": OBS[None]})
    mean, std = inputs[0, :6], np.exp(inputs[0, 6:])
    high = np.array(policy.contract.action_space.high)  # type: ignore[union-attr]
    samples = policy.act(np.tile(OBS, (20000, 1)), explore=True, seed=1) / high
    # The clipped Gaussian's median is its mean where the mean is inside, and the share at a bound is the tail's.
    inside = np.abs(mean) < 0.9
    np.testing.assert_allclose(
        np.median(samples, axis=0)[inside], mean[inside], atol=4 * std.max() * 1.25 / np.sqrt(20000)
    )
    assert (np.abs(samples) <= 1).all()


def test_a_discrete_policy_explores_with_the_softmax_frequencies(tmp_path: Path) -> None:
    folder = write_discrete_policy(tmp_path)
    (logits,) = onnxruntime.InferenceSession(folder / "policy.onnx").run(["action_dist_inputs"], {"obs": np.array([2])})
    expected = np.exp(logits[0]) / np.exp(logits[0]).sum()
    drawn = Policy.load(folder).act([2] * 20000, explore=True, seed=3)
    np.testing.assert_allclose(np.bincount(drawn, minlength=3) / 20000, expected, atol=0.015)


def test_a_policy_without_a_distribution_refuses_to_explore(tmp_path: Path) -> None:
    folder = write_discrete_policy(tmp_path)
    rewrite_contract(folder, distribution=None)
    with pytest.raises(RequestError, match="cannot explore"):
        Policy.load(folder).act(1, explore=True)


def test_an_action_outside_its_space_never_leaves(tmp_path: Path) -> None:
    policy = Policy.load(write_box_policy(tmp_path, action_scale=5.0))
    with pytest.raises(ActionError, match=r"element \d \(joint_\d\) is -?[\d.]+, not in \[-[12], [12]\]"):
        policy.act(OBS * 3)
    with pytest.raises(ActionError):
        policy.act(np.stack([OBS * 0, OBS * 3]))


def test_a_non_finite_action_never_leaves_even_an_unbounded_space(tmp_path: Path) -> None:
    import onnx
    from onnx import numpy_helper

    folder = write_box_policy(tmp_path, unbounded=True)
    model = onnx.load(folder / "policy.onnx")
    bias = next(tensor for tensor in model.graph.initializer if tensor.name == "b3")
    bias.CopyFrom(numpy_helper.from_array(np.array([0, 0, np.inf, 0, 0, 0], np.float32), "b3"))
    onnx.save(model, folder / "policy.onnx")
    write_contract(folder, read_contract(folder))
    policy = Policy.load(folder, check_golden=False)
    for obs in (OBS, np.stack([OBS, OBS])):
        with pytest.raises(ActionError, match=r"joint_2\) is inf, not a finite number"):
            policy.act(obs)


def test_an_overshoot_of_rounding_is_clipped(tmp_path: Path) -> None:
    folder = write_box_policy(tmp_path)
    space = read_contract(folder).action_space
    tighter = tuple(bound * (1 - 4e-6) for bound in space.high)  # type: ignore[union-attr]
    rewrite_contract(folder, action_space=space.model_copy(update={"high": tighter, "low": tuple(-b for b in tighter)}))
    action = Policy.load(folder).act(OBS * 30)  # saturates: the graph gives the wider bounds exactly
    assert (np.abs(action) <= np.array(tighter, np.float32)).all()
    assert (np.abs(action) == np.array(tighter, np.float32)).any()


def test_golden_vectors_that_do_not_reproduce_refuse_the_load(tmp_path: Path) -> None:
    folder = write_box_policy(tmp_path)
    inputs, outputs = (bundle := load_bundle(folder)).golden()
    outputs["action"][3, 2] += 0.01
    write_golden(folder, inputs, outputs)
    write_contract(folder, bundle.contract)
    with pytest.raises(GoldenMismatchError, match=r"1 of 48 values of 'action' differ, by up to 0.01"):
        Policy.load(folder)
    Policy.load(folder, check_golden=False)


def test_a_tampered_truncated_or_corrupt_bundle_is_refused(tmp_path: Path, ur5: Path) -> None:
    def copy(name: str) -> Path:
        return Path(shutil.copytree(ur5, tmp_path / name))

    one_byte = copy("one_byte")
    content = bytearray((one_byte / "policy.onnx").read_bytes())
    content[len(content) // 2] ^= 1
    (one_byte / "policy.onnx").write_bytes(content)
    with pytest.raises(BundleTamperedError, match=r"policy\.onnx is not the file that was exported"):
        Policy.load(one_byte)

    no_graph = copy("no_graph")
    (no_graph / "policy.onnx").unlink()
    with pytest.raises(BundleError, match=r"policy\.onnx is missing"):
        Policy.load(no_graph)

    corrupt = copy("corrupt")
    (corrupt / "policy.onnx").write_bytes(b"not a graph")
    write_contract(corrupt, read_contract(corrupt))
    with pytest.raises(BundleError, match="not a graph that onnxruntime can run"):
        Policy.load(corrupt)
    with pytest.raises(BundleError, match="does not exist"):
        Policy.load(tmp_path / "nowhere")


def test_a_contract_the_runtime_cannot_honour_is_refused(tmp_path: Path) -> None:
    folder = write_box_policy(tmp_path)
    good = read_contract(folder)
    narrow = good.observation_space.model_copy(update={"shape": (26,), "elements": ()})
    double = good.observation_space.model_copy(update={"dtype": "float64"})
    cases: list[tuple[dict[str, object], str]] = [
        ({"state": (StateSpec(name="h", dtype="float32", shape=(4,)),)}, r"lists no 'state_in.h' of shape \(-1, 4\)"),
        ({"inputs": ()}, "no input 'obs'"),
        ({"outputs": good.outputs[1:]}, "no output 'action'"),
        ({"distribution": Distribution(kind="categorical", transform="none")}, "needs the output 'action_dist_inputs'"),
        ({"outputs": (good.outputs[0].model_copy(update={"shape": (-1, 7)}), good.outputs[1])}, "shape"),
        ({"observation_space": narrow, "inputs": (good.inputs[0].model_copy(update={"shape": (-1, 26)}),)}, "shape"),
        (
            {"observation_space": narrow},
            r"the space of 'obs' is float32 of shape \(26,\), but the tensor is float32 of shape",
        ),
        (
            {"observation_space": double, "inputs": (good.inputs[0].model_copy(update={"dtype": "float64"}),)},
            "'obs' is float32 in the graph, float64 in contract.json",
        ),
    ]
    for changes, sentence in cases:
        rewrite_contract(folder, **changes)
        with pytest.raises(BundleError, match=sentence):
            Policy.load(folder)
        write_contract(folder, good)
    assert isinstance(Policy.load(folder).contract, Contract)


def test_a_closed_policy_does_not_act(ur5: Path) -> None:
    with Policy.load(ur5) as policy:
        policy.reset()
        policy.act(OBS)
    with pytest.raises(UsageError, match="closed"):
        policy.act(OBS)


def test_the_runtime_imports_no_framework() -> None:
    heavy = ["torch", "ray", "gymnasium", "fastapi", "starlette", "uvicorn", "mujoco", "onnx", "httptools", "httpx"]
    code = f"import sys, rlservo.policy.policy; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_loading_a_policy_starts_no_telemetry(ur5: Path, tmp_path: Path) -> None:
    """onnxruntime's uploader writes its session file, `.ses`, into the temporary folder as soon as it runs."""
    environment = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    code = f"from rlservo.policy.policy import Policy; Policy.load({str(ur5)!r}).act([0.0] * 27)"
    subprocess.run([sys.executable, "-c", code], check=True, env={**environment, "TMPDIR": str(tmp_path)})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("control_rate_hz", 0.0, "control_rate_hz: Input should be greater than 0"),
        ("parity.rtol", 0.5, "parity.rtol: Input should be less than or equal to 0.01"),
        ("parity.atol", -1.0, "parity.atol: Input should be greater than or equal to 0"),
        ("observation_space.shape", [0], "observation_space.box.shape.0: Input should be greater than or equal to 1"),
        ("inputs.0.shape", [27], r"inputs.0.shape: .*expected -1 for the batch, then positive sizes, got \[27\]"),
        ("inputs.0.shape", [-1, -1], "expected -1 for the batch"),
    ],
)
def test_a_contract_with_numbers_that_cannot_be_is_refused(
    tmp_path: Path, field: str, value: object, words: str
) -> None:
    folder = write_box_policy(tmp_path)
    document = json.loads((folder / "contract.json").read_text())
    *path, last = field.split(".")
    inside = document
    for key in path:
        inside = inside[int(key)] if isinstance(inside, list) else inside[key]
    inside[last] = value
    (folder / "contract.json").write_text(json.dumps(document))
    sums = [line for line in (folder / "SHA256SUMS").read_text().splitlines() if "contract.json" not in line]
    digest = hashlib.sha256((folder / "contract.json").read_bytes()).hexdigest()
    (folder / "SHA256SUMS").write_text("\n".join([*sums, f"{digest}  contract.json"]) + "\n")
    with pytest.raises(BundleError, match=words):
        Policy.load(folder)


@pytest.mark.parametrize("ragged", [[[0.0] * 27, [0.0] * 26], [[0.0] * 27, 1.0]])
def test_a_ragged_batch_is_refused_in_our_own_words(tmp_path: Path, ragged: list[object]) -> None:
    with pytest.raises(ObservationError, match="observation 1 of the batch") as caught:
        Policy.load(write_box_policy(tmp_path)).act(ragged)
    assert "array" not in caught.value.message and "inhomogeneous" not in caught.value.message
