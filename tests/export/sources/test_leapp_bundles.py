"""LEAPP bundles as its users write them, answered through Policy.load and by LEAPP's own InferenceManager."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from rlservo.errors import UnsupportedError
from rlservo.export.export_checkpoint import ExportResult, export_checkpoint
from rlservo.policy.policy import Policy

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
leapp: Any = None

Trace = Callable[[], None]
FORMATS = pytest.mark.parametrize("format", ["jit", "jit-trace", "onnx", "onnx-torchscript"])


@pytest.fixture(autouse=True, scope="module")
def imported() -> None:
    """Import LEAPP with the first test: it imports all of torch's compiler, which each process would when it starts."""
    global leapp
    leapp = pytest.importorskip("leapp")


def compiled(folder: Path, trace: Trace) -> Path:
    """Return the bundle that LEAPP writes for two steps of `trace`."""
    torch.manual_seed(0)
    leapp.start("bundle", save_path=str(folder), max_cached_io=2)
    try:
        trace()
        trace()
    finally:
        leapp.stop()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # LEAPP's own, about torch.jit and torch.onnx
        leapp.compile_graph(visualize=False)
    return folder / "bundle"


def frozen(network: Any) -> Any:
    return network.eval().requires_grad_(False)


def assert_same(bundle: Path, result: ExportResult, *, episodes: int = 2, steps: int = 20) -> None:
    """Compare episodes with those of a new InferenceManager, which is given the pipeline's inputs and nothing else."""
    described = yaml.safe_load((bundle / "bundle.yaml").read_text())
    models, pipeline = described["models"], described["pipeline"]
    shapes = {
        f"{stage}/{tensor['name']}": tuple(tensor["shape"])
        for stage, model in models.items()
        for tensor in (*model["inputs"], *model["outputs"])
    }
    inputs, outputs = (
        {f"{stage}/{name}": name for stage, names in pipeline[side].items() for name in names}
        for side in ("inputs", "outputs")
    )
    rng = np.random.default_rng(0)
    with Policy.load(result.path) as policy:
        for _ in range(episodes):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                manager = leapp.InferenceManager(str(bundle / "bundle.yaml"))
            policy.reset()
            for _ in range(steps):
                given = {key: rng.normal(0.0, 2.0, shapes[key]).astype(np.float32) for key in inputs}
                with torch.no_grad():
                    wanted = manager.run_policy({key: torch.tensor(value) for key, value in given.items()})
                obs = {inputs[key]: _row(value) for key, value in given.items()}
                action: Any = policy.act(obs if len(obs) > 1 else next(iter(obs.values())))
                for key, name in outputs.items():
                    answered = action[name] if len(outputs) > 1 else action
                    np.testing.assert_allclose(answered, _row(wanted[key].numpy()), rtol=1e-5, atol=2e-6)


def _row(value: Any) -> Any:
    return value[0] if value.ndim > 1 and len(value) == 1 else value


def mlp(format: str, **outputs: Any) -> Trace:
    """A network of one stage; `outputs` are for annotate.output_tensors."""
    network = frozen(torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.ELU(), torch.nn.Linear(8, 3)))

    def trace() -> None:
        x = leapp.annotate.input_tensors("net", {"obs": torch.randn(1, 4)})
        leapp.annotate.output_tensors("net", {"target": network(x)}, export_with=format, **outputs)

    return trace


def gains(kp: Any, kd: Any) -> list[Any]:
    kinds = leapp.OutputKindEnum
    return [
        leapp.TensorSemantics(name="stiffness", ref=kp, kind=kinds.KP),
        leapp.TensorSemantics(name="damping", ref=kd, kind=kinds.KD),
    ]


@FORMATS
def test_constant_gains_are_given_with_every_action(format: str, tmp_path: Path, notices: list[str]) -> None:
    constant = gains(torch.tensor([[40.0, 30.0, 20.0]]), torch.tensor([2.0, 1.0, 0.0]))
    bundle = compiled(tmp_path, mlp(format, static_outputs=constant))
    result = export_checkpoint(bundle, tmp_path / "out", notify=notices.append)
    assert_same(bundle, result)
    assert notices == []


@pytest.mark.parametrize("limit", [50.0, 1e5, 1e20])
@pytest.mark.parametrize("format", ["jit-trace", "onnx"])
def test_a_stage_that_stops_for_an_outlier_stops_for_its_own_row_alone(
    format: str, limit: float, tmp_path: Path, notices: list[str]
) -> None:
    network = frozen(torch.nn.Linear(4, 3))

    def trace() -> None:
        x = leapp.annotate.input_tensors("net", {"obs": torch.randn(1, 4)})
        stopped = torch.where((x.abs() > limit).any(), torch.zeros(3), network(x))
        leapp.annotate.output_tensors("net", {"target": stopped}, export_with=format)

    bundle = compiled(tmp_path, trace)
    result = export_checkpoint(bundle, tmp_path / "out", notify=notices.append)
    assert_same(bundle, result)
    obs = np.array([[0.5, -1.0, 2.0, 0.1], [0.0, 10 * limit, 0.0, 0.0]], np.float32)
    with Policy.load(result.path) as policy:
        calm, stopped = policy.act(obs)
        np.testing.assert_allclose(calm, policy.act(obs[0]), rtol=1e-5, atol=2e-6)
        np.testing.assert_array_equal(stopped, 0.0)


@pytest.mark.parametrize(("kp", "kd", "words"), [(0.0, 3.0, "stiffness is 0"), (50.0, -0.0, "damping is -?0")])
def test_gains_that_are_only_zeros_or_ones_are_warned_of(
    kp: float, kd: float, words: str, tmp_path: Path, notices: list[str]
) -> None:
    constant = gains(torch.full((1, 3), kp), torch.full((1, 3), kd))
    bundle = compiled(tmp_path, mlp("jit-trace", static_outputs=constant))
    export_checkpoint(bundle, tmp_path / "out", notify=notices.append)
    (notice,) = notices
    assert re.search(rf"net/{words} for every joint", notice)


def lstm(format: str) -> Trace:
    network, head = frozen(torch.nn.LSTM(4, 8, num_layers=2)), frozen(torch.nn.Linear(8, 3))

    def trace() -> None:
        x = leapp.annotate.input_tensors("net", {"obs": torch.randn(1, 4)})
        zeros = {"h": torch.full((2, 1, 8), 0.3), "c": torch.zeros(2, 1, 8)}
        y, (h, c) = network(x.unsqueeze(0), leapp.annotate.state_tensors("net", zeros))
        leapp.annotate.update_state("net", {"h": h, "c": c})
        leapp.annotate.output_tensors("net", {"action": head(y[0])}, export_with=format)

    return trace


def gru(format: str) -> Trace:
    network, head = frozen(torch.nn.GRU(4, 8)), frozen(torch.nn.Linear(8, 3))

    def trace() -> None:
        x = leapp.annotate.input_tensors("net", {"obs": torch.randn(1, 4)})
        y, h = network(x.unsqueeze(0), leapp.annotate.state_tensors("net", {"h": torch.zeros(1, 1, 8)}))
        leapp.annotate.update_state("net", {"h": h})
        leapp.annotate.output_tensors("net", {"action": head(y[0])}, export_with=format)

    return trace


def one_layer(format: str) -> Trace:
    """States `[1, 1, 8]`, whose first axis is the layers'."""
    network, head = frozen(torch.nn.LSTM(4, 8)), frozen(torch.nn.Linear(8, 3))

    def trace() -> None:
        x = leapp.annotate.input_tensors("net", {"obs": torch.randn(1, 4)})
        zeros = {"h": torch.zeros(1, 1, 8), "c": torch.zeros(1, 1, 8)}
        y, (h, c) = network(x.unsqueeze(0), leapp.annotate.state_tensors("net", zeros))
        leapp.annotate.update_state("net", {"h": h, "c": c})
        leapp.annotate.output_tensors("net", {"action": head(y[0])}, export_with=format)

    return trace


def splits(format: str) -> Trace:
    def trace() -> None:
        x = leapp.annotate.input_tensors("net", {"obs": torch.randn(1, 6)})
        a, b = x.split(3, -1)
        c, d = torch.chunk(a * b, 2, -1)
        leapp.annotate.output_tensors("net", {"action": torch.cat([b, d, c], -1)}, export_with=format)

    return trace


def unbatched(format: str) -> Trace:
    """LEAPP's README: vectors without a batch, and a mean over all numbers."""
    weights = torch.linspace(-1.0, 1.0, 32).reshape(8, 4)

    def trace() -> None:
        x = leapp.annotate.input_tensors("preprocess", {"obs": torch.randn(8)})
        features = (x - x.mean()) / (x.std() + 1e-6)
        features = leapp.annotate.output_tensors("preprocess", {"features": features}, export_with=format)
        features = leapp.annotate.input_tensors("policy", {"features": features})
        leapp.annotate.output_tensors("policy", {"action": torch.tanh(features @ weights)}, export_with=format)

    return trace


def mixes_rows(format: str) -> Trace:
    def trace() -> None:
        x = leapp.annotate.input_tensors("net", {"obs": torch.randn(1, 4)})
        y = torch.tanh(x - 0.5 * x.mean(0, keepdim=True)) + x.std()
        leapp.annotate.output_tensors("net", {"action": y.reshape(1, -1)}, export_with=format)

    return trace


def feedback(format: str) -> Trace:
    """The later stage's result is the earlier one's input of the next step, and a counter is an integer."""
    network = frozen(torch.nn.Linear(4, 3))
    last: dict[str, Any] = {"y": torch.full((1, 3), 0.5)}

    def trace() -> None:
        x, y = leapp.annotate.input_tensors("first", {"obs": torch.randn(1, 4), "last": last["y"]})
        count = leapp.annotate.state_tensors("first", {"count": torch.zeros(1, dtype=torch.int64)})
        leapp.annotate.update_state("first", {"count": count + 1})
        h = torch.cat([x[:, :3] + y, torch.sin(0.3 * count.float()).reshape(1, 1)], -1)
        h = leapp.annotate.output_tensors("first", {"h": h}, export_with=format)
        y = network(leapp.annotate.input_tensors("second", {"h": h}))
        leapp.annotate.output_tensors("second", {"y": y, "action": 2.0 * y}, export_with=format)
        last["y"] = y

    return trace


@FORMATS
@pytest.mark.parametrize("policy", [lstm, one_layer, gru, splits, unbatched, mixes_rows, feedback])
def test_a_bundle_answers_as_leapp_does(policy: Callable[[str], Trace], format: str, tmp_path: Path) -> None:
    bundle = compiled(tmp_path, policy(format))
    result = export_checkpoint(bundle, tmp_path / "out", notify=lambda _: None)
    assert_same(bundle, result)


@pytest.mark.parametrize(
    ("dtype", "words"),
    [("float64", "input net/obs is float64: an exported policy sees observations in single precision"),
     ("int64", "input net/obs is int64: only floating-point tensors are exported")],
)  # fmt: skip
def test_observations_of_other_types_are_refused_with_the_reason(dtype: str, words: str, tmp_path: Path) -> None:
    def trace() -> None:
        x = leapp.annotate.input_tensors("net", {"obs": torch.ones(1, 4, dtype=getattr(torch, dtype))})
        leapp.annotate.output_tensors("net", {"action": 2.0 * x}, export_with="jit-trace")

    with pytest.raises(UnsupportedError, match=words):
        export_checkpoint(compiled(tmp_path, trace), tmp_path / "out", notify=lambda _: None)


def test_a_stage_with_a_memory_of_its_own_is_refused_by_its_buffer(tmp_path: Path) -> None:
    class Counting(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("steps", torch.zeros(1, 3))
            self.layer = frozen(torch.nn.Linear(4, 3))

        def forward(self, x: Any) -> Any:
            self.steps += 1.0
            return self.layer(x) + self.steps

    bundle = compiled(tmp_path, mlp("jit"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.trace(Counting(), torch.zeros(1, 4), check_trace=False).save(str(bundle / "net.pt"))
    _edit(bundle, r"sha256sum: \w+", f"sha256sum: {sha256((bundle / 'net.pt').read_bytes()).hexdigest()}")
    with pytest.raises(UnsupportedError, match="stage 'net' changes its own buffer 'steps' when it runs"):
        export_checkpoint(bundle, tmp_path / "out", notify=lambda _: None)


def _two(format: str) -> Trace:
    network = frozen(torch.nn.Linear(4, 3))

    def trace() -> None:
        x, bias = leapp.annotate.input_tensors("first", {"obs": torch.randn(1, 4), "bias": torch.randn(1, 4)})
        h = leapp.annotate.output_tensors("first", {"h": torch.tanh(x) + bias}, export_with=format)
        h = leapp.annotate.input_tensors("second", {"h": h})
        leapp.annotate.output_tensors("second", {"action": network(h)}, export_with=format)

    return trace


def _edit(bundle: Path, pattern: str, instead: str) -> None:
    text, count = re.subn(pattern, instead, (bundle / "bundle.yaml").read_text())
    assert count == 1
    (bundle / "bundle.yaml").write_text(text)


def test_a_stage_before_the_one_that_feeds_it_gets_the_value_of_the_step_before(tmp_path: Path) -> None:
    bundle = compiled(tmp_path, _two("jit-trace"))
    described = yaml.safe_load((bundle / "bundle.yaml").read_text())
    described["models"] = {name: described["models"][name] for name in ("second", "first")}
    (bundle / "bundle.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
    result = export_checkpoint(bundle, tmp_path / "out", notify=lambda _: None)
    assert [leaf.name for leaf in result.contract.state] == ["second.h"]
    assert_same(bundle, result)


def test_an_input_that_nothing_feeds_stays_zero(tmp_path: Path) -> None:
    bundle = compiled(tmp_path, _two("jit-trace"))
    _edit(bundle, r"first: \[obs, bias\]", "first: [obs]")
    result = export_checkpoint(bundle, tmp_path / "out", notify=lambda _: None)
    assert result.contract.state == ()
    assert_same(bundle, result)


def test_a_custom_operator_is_refused_by_its_domain_and_name(tmp_path: Path) -> None:
    from rlservo.export.sources.onnx_stage import OnnxStage

    node = onnx.helper.make_node("WrpRunner", ["x"], ["y"], domain="com.nvidia.warp")
    x, y = (onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, 3]) for name in "xy")
    onnx.save(onnx.helper.make_model(onnx.helper.make_graph([node], "stage", [x], [y])), str(tmp_path / "stage.onnx"))
    with pytest.raises(
        UnsupportedError, match=r"stage.onnx has the operation com.nvidia.warp::WrpRunner, a custom one"
    ):
        OnnxStage(tmp_path / "stage.onnx")


def stage(folder: Path, node: Any, size: int) -> Any:
    """Return a stage in which `node` gives y and takes `at`, which is 1 for numbers above 1e7 in x and else 0."""
    from rlservo.export.sources.onnx_stage import OnnxStage

    make, kinds = onnx.helper, onnx.TensorProto
    nodes = [
        make.make_node("ReduceMax", ["x"], ["most"], keepdims=int(node.op_type == "Slice"), axes=[0]),
        make.make_node("Greater", ["most", "limit"], ["is_far"]),
        make.make_node("Cast", ["is_far"], ["at"], to=kinds.INT64),
        node,
    ]
    x, y = (make.make_tensor_value_info(name, kinds.FLOAT, [n]) for name, n in (("x", 4), ("y", size)))
    kept = [onnx.numpy_helper.from_array(values, name) for values, name in (
        (np.float32(1e7).reshape(()), "limit"), (np.float32([[1, 2, 3], [4, 5, 6]]), "table"), (np.array([4]), "end"),
    )]  # fmt: skip
    onnx.save(make.make_model(make.make_graph(nodes, "stage", [x], [y], kept)), str(folder / "stage.onnx"))
    return OnnxStage(folder / "stage.onnx")


def test_a_row_that_the_observation_chooses_is_not_frozen_in_a_trace(tmp_path: Path) -> None:
    gather = stage(tmp_path, onnx.helper.make_node("Gather", ["table", "at"], ["y"], axis=0), 3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's, about torch.jit
        traced = torch.jit.trace(gather, (torch.zeros(4),))
    for x, wanted in ((torch.zeros(4), [1.0, 2.0, 3.0]), (torch.full((4,), 1e8), [4.0, 5.0, 6.0])):
        np.testing.assert_array_equal(traced(x)[0].numpy(), wanted)


def test_a_size_that_the_observation_decides_is_refused_by_its_operator(tmp_path: Path) -> None:
    cut = stage(tmp_path, onnx.helper.make_node("Slice", ["x", "at", "end"], ["y"]), 4)
    with pytest.raises(UnsupportedError, match="Slice 'y' takes a size or an axis that depends on the observation"):
        cut(torch.zeros(4))


@pytest.mark.parametrize("bidirectional", [False, True])
@pytest.mark.parametrize("kind", ["LSTM", "GRU"])
def test_recurrent_operators_give_what_onnxruntime_gives(kind: str, bidirectional: bool, tmp_path: Path) -> None:
    from rlservo.export.sources.onnx_stage import OnnxStage

    torch.manual_seed(0)
    network = frozen(getattr(torch.nn, kind)(5, 7, num_layers=2, bidirectional=bidirectional))
    sequence, file = torch.randn(4, 1, 5), tmp_path / "stage.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(network, (sequence,), str(file), input_names=["x"], dynamo=False, opset_version=17)
    wanted = onnxruntime.InferenceSession(str(file)).run(None, {"x": sequence.numpy()})
    for ours, theirs in zip(OnnxStage(file)(sequence), wanted, strict=True):
        np.testing.assert_allclose(ours.numpy(), theirs, rtol=1e-5, atol=1e-6)
