"""Compiled policies in this process: they act, refuse and remember as the bundle does."""

from __future__ import annotations

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")  # compiling needs it; the newest Python runs the unit tests without

from bundles import write_leaky_policy
from rlservo.errors import BundleError, BundleTamperedError, ObservationError, RequestError
from rlservo.export.compiled.compile import Compiled, compile_bundle
from rlservo.policy.compiled_policy import CompiledPolicy, open_policy
from rlservo.policy.policy import Policy

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
OBS = np.linspace(-1, 1, 27, dtype=np.float32)


@pytest.fixture(scope="module")
def leaky(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Compiled]:
    """A policy with a memory: its bundle, and its C."""
    root = tmp_path_factory.mktemp("leaky")
    bundle = write_leaky_policy(root)
    return bundle, compile_bundle(bundle, root / "c")


def test_a_memory_goes_on_from_step_to_step_until_reset(leaky: tuple[Path, Compiled]) -> None:
    bundle, made = leaky
    with Policy.load(bundle) as policy, CompiledPolicy(made.folder) as compiled:
        for step in range(12):
            if step == 7:
                policy.reset()
                compiled.reset()
            obs = np.float32([0.1, -0.02 * step, 0.3])
            np.testing.assert_allclose(compiled.act(obs), policy.act(obs), rtol=1e-6, atol=1e-7)


def test_a_batch_is_so_many_episodes_side_by_side(leaky: tuple[Path, Compiled]) -> None:
    bundle, made = leaky
    with Policy.load(bundle) as policy, CompiledPolicy(made.folder) as compiled:
        for step in range(3):
            obs = np.float32([[0.1, 0.2, 0.1 * step], [-0.3, 0.1, 0.0]])
            np.testing.assert_allclose(compiled.act(obs), policy.act(obs), rtol=1e-6, atol=1e-7)


def test_threads_with_a_clone_each_do_not_disturb_one_another(leaky: tuple[Path, Compiled]) -> None:
    _, made = leaky
    with CompiledPolicy(made.folder) as compiled:
        alone = [compiled.act(np.float32([0.1 * i, 0.2, 0.3])) for i in range(200)]

        def drive(_: int) -> list[np.ndarray]:
            with compiled.clone() as own:
                return [own.act(np.float32([0.1 * i, 0.2, 0.3])) for i in range(200)]

        with ThreadPoolExecutor(4) as threads:
            for actions in threads.map(drive, range(4)):
                assert np.array_equal(actions, alone)


def test_a_bad_observation_is_refused_in_the_bundles_own_words(ur5: Path, leaky: tuple[Path, Compiled]) -> None:
    bundle, made = leaky
    with Policy.load(bundle) as policy, CompiledPolicy(made.folder) as compiled:
        for obs in ([0.1, np.nan, 0.2], [0.1, 0.2]):
            sentences = []
            for each in (policy, compiled):
                with pytest.raises(ObservationError) as refused:
                    each.act(np.float32(obs))
                sentences.append(str(refused.value))
            assert sentences[0] == sentences[1]
        with pytest.raises(RequestError, match="has no action distribution and cannot explore"):
            compiled.act(np.float32([0, 0, 0]), explore=True)
        assert compiled.value(np.float32([0, 0, 0])) is None


def test_the_library_itself_names_the_element_that_is_not_a_number(leaky: tuple[Path, Compiled]) -> None:
    """As a C program meets it: without Python's checks before it."""
    _, made = leaky
    with CompiledPolicy(made.folder) as compiled:
        run = compiled.network()
        feed = {"obs": np.float32([[0.1, np.inf, 0.2]]), "state_in.h": np.zeros((1, 2), np.float32)}
        with pytest.raises(ObservationError, match=r"an observation is not a finite number: element 1 \(obs\)"):
            run(feed)


def test_a_folder_is_opened_as_what_it_is(leaky: tuple[Path, Compiled]) -> None:
    bundle, made = leaky
    with open_policy(bundle) as one, open_policy(made.folder) as other:
        assert (type(one), type(other)) == (Policy, CompiledPolicy)
        assert one.digest == other.digest


def test_another_library_than_the_proven_one_is_not_loaded(leaky: tuple[Path, Compiled], tmp_path: Path) -> None:
    copy = shutil.copytree(leaky[1].folder, tmp_path / "c")
    with (copy / "libleaky.so").open("ab") as file:
        file.write(b"x")
    with pytest.raises(BundleTamperedError, match=r"libleaky.so is not the proven file"):
        CompiledPolicy(copy)


def test_a_folder_without_a_library_says_why(leaky: tuple[Path, Compiled], tmp_path: Path) -> None:
    copy = shutil.copytree(leaky[1].folder, tmp_path / "c")
    about = json.loads((copy / "compile.json").read_text())
    (copy / "compile.json").write_text(json.dumps({**about, "library": None, "unproven": "no C compiler was found"}))
    with pytest.raises(BundleError, match=r"has no library: it was written without a C compiler \(no C compiler"):
        CompiledPolicy(copy)
    with pytest.raises(BundleError, match=r"holds no compiled policy: expected compile\.json"):
        CompiledPolicy(tmp_path)
