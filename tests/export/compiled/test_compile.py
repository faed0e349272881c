"""`rlservo compile`: its files, its proof and its refusals."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from bundles import rewrite_contract, write_box_policy
from command_line import rlservo_here
from rlservo.bundle.spaces import BoxSpec, Element
from rlservo.errors import ParityError, UsageError
from rlservo.export.compiled import proof
from rlservo.export.compiled.compile import Compiled, compile_bundle
from rlservo.policy.compiled_policy import CompiledPolicy
from rlservo.policy.policy import Policy

if TYPE_CHECKING:
    from rlservo.export.export_checkpoint import ExportResult

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
SOURCES = ("ur5.c", "ur5.h", "ur5_test.c", "contract.json")


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without a C compiler."""
    monkeypatch.setattr(proof, "COMPILERS", ())
    monkeypatch.delenv("CC", raising=False)


def test_the_proof_and_its_figures_stand_in_compile_json(compiled_ur5: Compiled) -> None:
    about = json.loads((compiled_ur5.folder / "compile.json").read_text())
    assert about["unproven"] is None
    assert about["proof"]["golden_vectors"] == 8
    assert about["proof"]["observations"] == 10_000
    assert 0 < about["proof"]["max_rel"] < 1
    assert 0 <= about["proof"]["rounding_used"] < 100 and 0 <= about["proof"]["rounding_most"] < 10
    times = about["proof"]["step_us"]
    assert 0 < times["median"] <= times["longest"] and 0 < times["slowest_observation"] <= times["longest"]
    assert 0 < about["proof"]["stack_bytes"] < 4096  # under -march=native: more where vectors have 64 bytes
    assert about["proof"]["code_bytes"] < 400_000  # weights and all
    assert set(SOURCES) < set(about["files"])


def test_without_a_compiler_the_same_files_are_written_and_called_unproven(
    compiled_ur5: Compiled, ur5: Path, tmp_path: Path, no_compiler: None
) -> None:
    said = rlservo_here("compile", ur5, "--out", tmp_path / "c")
    assert said.returncode == 0
    assert "unproven  no C compiler was found; run the self-test on a machine that has one" in said.stdout
    for name in SOURCES:
        assert (tmp_path / "c" / name).read_bytes() == (compiled_ur5.folder / name).read_bytes(), name
    assert json.loads((tmp_path / "c" / "compile.json").read_text())["proof"] is None
    assert not list((tmp_path / "c").glob("*.so"))


def test_a_compiler_that_does_not_exist_is_one_sentence(ur5: Path, tmp_path: Path) -> None:
    said = rlservo_here("compile", ur5, "--out", tmp_path / "c", "--cc", "no-such-cc")
    assert said.returncode == 2
    assert said.stderr.strip() == "rlservo: there is no C compiler 'no-such-cc' on this machine"
    assert not (tmp_path / "c").exists()


@needs_compiler
def test_c_that_differs_from_onnxruntime_is_not_written(
    ur5: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = proof.build

    def build(compiler: str, folder: Path, prefix: str, library: str) -> tuple[str, ...]:
        source = folder / f"{prefix}.c"
        source.write_text(source.read_text().replace("tanh_of(x0[i0])", "0.5f * tanh_of(x0[i0])"))
        return written(compiler, folder, prefix, library)

    monkeypatch.setattr(proof, "build", build)
    with pytest.raises(ParityError, match="does not reproduce the golden vectors: vector 0, action, element 0"):
        compile_bundle(ur5, tmp_path / "c")
    assert list(tmp_path.iterdir()) == []


def test_what_a_user_changed_is_not_overwritten(ur5: Path, tmp_path: Path, no_compiler: None) -> None:
    out = tmp_path / "c"
    compile_bundle(ur5, out)
    (out / "notes.txt").write_text("mine")
    compile_bundle(ur5, out)  # its own files are replaced
    assert (out / "notes.txt").read_text() == "mine"
    (out / "ur5.h").write_text("mine")
    with pytest.raises(UsageError, match=r"ur5\.h is not what `rlservo compile` wrote"):
        compile_bundle(ur5, out)
    assert (out / "ur5.h").read_text() == "mine"


def test_two_policies_do_not_share_a_folder(policies: Path, tmp_path: Path, no_compiler: None) -> None:
    compile_bundle(policies / "ur5", tmp_path / "c")
    with pytest.raises(UsageError, match="holds the compiled policy 'ur5': give 'gridworld' a folder of its own"):
        compile_bundle(policies / "gridworld", tmp_path / "c")


@needs_compiler
def test_hostile_names_stay_comments_strings_and_identifiers(tmp_path: Path) -> None:
    names = ["*/ int x; /*", 'a"b\\', "int", "size", "size", "", "\u202eevil\n#error", "??/", "x" * 300, "unnamed", "Ω"]
    names += [f"same {i % 2}" for i in range(27 - len(names))]
    folder = write_box_policy(tmp_path, name="int.c-2")
    observed = BoxSpec(shape=(27,), dtype="float32", low=None, high=None,
                       elements=tuple(Element(name=name, unit="*/") for name in names))  # fmt: skip
    rewrite_contract(folder, observation_space=observed, description="*/ #error \\")
    made = compile_bundle(folder, tmp_path / "c")
    assert made.proof is not None and made.about["prefix"] == "int_c_2"
    text = (tmp_path / "c" / "int_c_2.h").read_text()
    assert text.isascii()
    assert [f"INT_C_2_OBS_{name} =" in text for name in ("INT_X", "INT", "SIZE_2", "SIZE_3", "UNNAMED", "UNNAMED_2")]
    subprocess.run(["cc", "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-c", "int_c_2.c", "-o", "x.o"],
                   cwd=tmp_path / "c", check=True)  # fmt: skip


ZOO = ("act_nested", "stacked", "image", "user_gru", "obs_multi_discrete", "lstm_previous")


@needs_compiler
@pytest.mark.parametrize("name", ZOO)
def test_policies_of_every_kind_act_as_in_onnxruntime(
    wide_zoo: Path, exported: Callable[..., ExportResult], tmp_path: Path, name: str
) -> None:
    """Nested spaces, memories, images, choices: an episode of each, and its self-test under sanitizers."""
    bundle = exported(wide_zoo / name).path
    made = compile_bundle(bundle, tmp_path / "c")
    assert made.proof is not None and made.proof.max_rel < 1
    sources = [made.folder / f"{made.about['prefix']}{end}" for end in (".c", "_test.c")]
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    subprocess.run(["cc", "-std=c99", *proof.WARNINGS, *sanitizers, *sources, "-o", tmp_path / "t", "-lm"], check=True)
    subprocess.run([tmp_path / "t"], check=True, capture_output=True)
    with Policy.load(bundle) as policy, CompiledPolicy(made.folder) as compiled:
        inputs = dict(policy_inputs(policy).items())
        state = other = None
        for row in range(20):
            obs = {key: array[row] for key, array in inputs.items()}
            reward = {"reward": 0.5} if policy.sees_reward else {}
            one = policy.step(_observation(policy, obs), before=state, **reward)
            two = compiled.step(_observation(policy, obs), before=other, **reward)
            state, other = one.state or None, two.state or None
            for leaf, value in one.leaves.items():
                np.testing.assert_allclose(two.leaves[leaf], value, rtol=1e-4, atol=1e-5)


def policy_inputs(policy: Policy) -> dict[str, np.ndarray]:
    from rlservo.bundle.bundle import load_bundle

    golden, _ = load_bundle(policy.path).golden()
    return {name: array for name, array in golden.items() if name.startswith("obs")}


def _observation(policy: Policy, leaves: dict[str, np.ndarray]) -> object:
    from rlservo.bundle.nested import build_action

    return build_action(policy.contract.observation_space, leaves, "obs")
