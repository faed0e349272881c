"""LEAPP bundles of two stages with a state, against LEAPP's own replay."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rlservo.errors import CheckpointError, RlservoError, UnsupportedError
from rlservo.export.export_checkpoint import export_checkpoint
from rlservo.policy.policy import Policy

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")


@pytest.fixture(scope="module", params=["jit-trace", "onnx-torchscript"])
def bundle(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """An arm: joints and velocities are put side by side with the last action, then a network gives targets."""
    leapp = pytest.importorskip("leapp")  # here: it imports all of torch's compiler
    folder = tmp_path_factory.mktemp("leapp")
    format = request.param
    torch.manual_seed(0)
    layers = torch.nn.Sequential(torch.nn.Linear(7, 8), torch.nn.ELU(), torch.nn.Linear(8, 3))
    net = layers.eval().requires_grad_(False)
    kinds = leapp.InputKindEnum
    leapp.start("arm", save_path=str(folder), max_cached_io=2)
    for _ in range(2):
        joints, velocities = leapp.annotate.input_tensors("before", [
            leapp.TensorSemantics(name="q", ref=torch.randn(1, 2), kind=kinds.JOINT_POSITION,
                                  element_names=[["pan", "lift"]]),
            leapp.TensorSemantics(name="dq", ref=torch.randn(1, 2), kind=kinds.JOINT_VELOCITY),
        ])  # fmt: skip
        last = _only(leapp.annotate.state_tensors("before", {"last": torch.full((1, 3), 0.25)}))
        seen = torch.cat([2.0 * joints, velocities, last], dim=-1)
        leapp.annotate.update_state("before", {"last": 0.5 * last + 0.1 * seen[:, :3]})
        seen = _only(leapp.annotate.output_tensors("before", {"seen": seen}, export_with=format))
        seen = _only(leapp.annotate.input_tensors("network", {"seen": seen}))
        target = leapp.TensorSemantics(
            name="target",
            ref=0.5 * net(seen),
            kind=leapp.OutputKindEnum.JOINT_POSITION,
            element_names=[["a", "b", "c"]],
            extra={"units": ["rad", "rad", "m"]},
        )
        leapp.annotate.output_tensors("network", [target], export_with=format)
    leapp.stop()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # LEAPP's own, about torch.jit
        leapp.compile_graph(visualize=False, graph_configs=leapp.GraphConfigs(frequency=20.0))
    return folder / "arm"


def _only(tensors: Any) -> Any:
    return tensors[0] if isinstance(tensors, tuple | list) else tensors


def test_stages_are_chained_and_kinds_become_names_and_units(bundle: Path, tmp_path: Path, notices: list[str]) -> None:
    import leapp

    result = export_checkpoint(bundle, tmp_path, notify=notices.append)
    contract = result.contract
    assert not any("loading" in notice for notice in notices)
    assert [(e.name, e.unit) for e in contract.action_space.elements] == [("a", "rad"), ("b", "rad"), ("c", "m")]
    joints = contract.observation_space.spaces["q"]  # type: ignore[union-attr]
    assert [(e.name, e.unit) for e in joints.elements] == [("pan", ""), ("lift", "")]
    assert [(e.quantity, e.joint) for e in joints.elements] == [("joint position", "pan"), ("joint position", "lift")]
    assert {e.quantity for e in contract.action_space.elements} == {"joint position"}
    assert [notice for notice in notices if "whether a joint turns or slides, so before/q get no unit" in notice]
    assert contract.control_rate_hz == 20.0
    assert [leaf.initial for leaf in contract.state] == [0.25]
    rng = np.random.default_rng(0)
    with Policy.load(result.path) as policy:
        for _ in range(2):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                manager = leapp.InferenceManager(str(bundle / "arm.yaml"))
            policy.reset()
            for _ in range(6):
                obs = {"q": rng.normal(size=2).astype(np.float32), "dq": rng.normal(size=2).astype(np.float32)}
                given = {f"before/{key}": torch.from_numpy(value)[None] for key, value in obs.items()}
                wanted = manager.run_policy(given)["network/target"][0].numpy()
                np.testing.assert_allclose(policy.act(obs), wanted, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        (("backend: (jit|onnx)", "backend: pt2"), UnsupportedError, "backend 'pt2': only TorchScript and ONNX can be"),
        ((r"model_path: before\.", "model_path: after."), CheckpointError, "after.(pt|onnx) is not beside it"),
        (("sha256sum: ", "sha256sum: 0"), CheckpointError, "cannot be loaded by LEAPP"),
        ((r"shape: \[1, 2\]", "shape: [9]"), CheckpointError, "do not run on tensors as it describes them"),
        (("warp_segments: 0", "warp_segments: 1"), UnsupportedError, "'before' has 1 Warp segments .*WrpRunner"),
        ((r"(?s)outputs:\n    network:.*?\n", "outputs: {}\n"), UnsupportedError, "has no outputs"),
        (("name: q", "nam: q"), CheckpointError, "is not as LEAPP writes it: KeyError: 'name'"),
    ],
)
def test_broken_bundles_are_refused_with_the_reason(
    change: tuple[str, str], kind: type[RlservoError], words: str, bundle: Path, tmp_path: Path
) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    for file in bundle.iterdir():
        (broken / file.name).write_bytes(file.read_bytes())
    changed, count = re.subn(*change, (broken / "arm.yaml").read_text())
    assert count
    (broken / "arm.yaml").write_text(changed)
    with pytest.raises(kind, match=words):
        export_checkpoint(broken, tmp_path / "out", notify=lambda _: None)


def test_an_onnx_stage_gives_what_onnxruntime_gives_for_each_row(tmp_path: Path) -> None:
    from rlservo.export.sources.onnx_stage import OnnxStage

    class Network(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.first, self.last, self.norm = torch.nn.Linear(6, 8), torch.nn.Linear(8, 3), torch.nn.LayerNorm(8)

        def forward(self, x: Any) -> Any:
            parts = x.reshape(1, 2, 3)[:, [1, 0]].flatten(1)
            hidden = self.norm(torch.nn.functional.elu(self.first(torch.cat([parts[:, 3:], parts[:, :3]], dim=1))))
            return torch.clamp(self.last(hidden) / 0.5, -0.4, 0.7).softmax(-1), x[:, 1:5:2].tanh()

    torch.manual_seed(0)
    file = tmp_path / "stage.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            Network().eval(), (torch.zeros(1, 6),), str(file), input_names=["x"], output_names=["y", "z"],
            opset_version=17, dynamo=False,
        )  # fmt: skip
    rows = torch.randn(5, 6)
    with torch.no_grad():
        found = OnnxStage(file)(rows)
    session = onnxruntime.InferenceSession(str(file))
    wanted = [session.run(None, {"x": row[None].numpy()}) for row in rows]
    for ours, theirs in zip(found, zip(*wanted, strict=True), strict=True):
        np.testing.assert_allclose(ours.numpy(), np.concatenate(theirs), rtol=1e-5, atol=1e-6)


def test_an_onnx_stage_of_an_operation_that_is_not_known_is_refused_by_name(tmp_path: Path) -> None:
    from rlservo.export.sources.onnx_stage import OnnxStage

    node = onnx.helper.make_node("Hardmax", ["x"], ["y"])
    x, y = (onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, 3]) for name in "xy")
    onnx.save(onnx.helper.make_model(onnx.helper.make_graph([node], "stage", [x], [y])), str(tmp_path / "stage.onnx"))
    with pytest.raises(UnsupportedError, match=r"stage.onnx has the operation Hardmax, .* export_with='jit-trace'"):
        OnnxStage(tmp_path / "stage.onnx")


@pytest.mark.parametrize(("parts", "order"), [("xyzw", "xyzw"), ("wxyz", "")])
def test_pose_command_of_isaac_labs_betas_does_not_tell_its_order(
    parts: str, order: str, tmp_path: Path, notices: list[str]
) -> None:
    """3.0's betas name the parts w, x, y, z, and give x, y, z, w."""
    leapp = pytest.importorskip("leapp")
    torch.manual_seed(0)
    net = torch.nn.Linear(7, 2).eval().requires_grad_(False)
    leapp.start("reach", save_path=str(tmp_path / "leapp"), max_cached_io=2)
    for _ in range(2):
        pose = leapp.TensorSemantics(
            name="pose", ref=torch.randn(1, 7), kind=leapp.InputKindEnum.COMMAND_POSE,
            element_names=[["x", "y", "z", *(f"q{part}" for part in parts)]], extra={"frame": "base"},
        )  # fmt: skip
        seen = _only(leapp.annotate.input_tensors("act", [pose]))
        target = leapp.TensorSemantics(name="target", ref=net(seen), kind=leapp.OutputKindEnum.JOINT_VELOCITY,
                                       element_names=[["a", "b"]], extra={"units": "rad/s"})  # fmt: skip
        leapp.annotate.output_tensors("act", [target], export_with="jit-trace")
    leapp.stop()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        leapp.compile_graph(visualize=False)
    contract = export_checkpoint(tmp_path / "leapp" / "reach", tmp_path, notify=notices.append).contract
    elements = contract.observation_space.elements
    assert [(one.quantity, one.axis, one.frame) for one in elements[:3]] == [("position", a, "base") for a in "xyz"]
    assert "".join(one.axis for one in elements[3:]) == order
    assert {one.quantity for one in elements[3:]} == {"quaternion"}
    assert {one.quantity for one in contract.action_space.elements} == {"joint velocity"}
    assert any("--convention quaternion=wxyz or xyzw" in notice for notice in notices) == (order == "")
