"""Private names of RLlib: a Ray that lacks one is refused by its version before anything is exported."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import ray

from rlservo.errors import UnsupportedError
from rlservo.export.checkpoints.location import locate_checkpoint
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.rllib import private_names
from rlservo.export.rllib.restore import restore

ROOT = Path(__file__).resolve().parents[3]
RLLIB = ROOT / "export" / "rllib"


def calls() -> Iterator[tuple[str, list[Any]]]:
    """Yield (function, constant arguments) of each call of `private_names` in export/rllib."""
    for file in RLLIB.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("private_names."):
                yield ast.unparse(node.func), [one.value for one in node.args if isinstance(one, ast.Constant)]


def test_no_private_attribute_is_read_past_the_check() -> None:
    past: list[str] = []
    for file in RLLIB.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.endswith("__"):
                if ast.unparse(node.value) not in ("self", "super()"):
                    past.append(f"{file.name}:{node.lineno}: {ast.unparse(node)}")
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ray"):
                past += [f"{file.name}: {alias.name}" for alias in node.names if alias.name.startswith("_")]
    assert not past


ATTRIBUTES = {
    "_update_stats": ("MeanStdFilter", "zoo", "pendulum", None),
    "_filters": ("MeanStdFilter", "zoo", "pendulum", None),
    "_agent_ids": ("FlattenObservations", "wide_zoo", "obs_dict", None),
    "_keys_to_remove": ("FlattenObservations", "wide_zoo", "obs_dict", None),
    "_device": ("NumpyToTensor", "zoo", "pendulum", None),
    "_agent_to_module_mapping_fn": ("AgentToModuleMapping", "wide_zoo", "plain_team", "arms"),
    "_preprocessor": ("ObsPreprocessorConnector", "old_zoo", "pendulum", None),
    "_obs_space": ("Preprocessor", "old_zoo", "pendulum", None),
}
"""The class that has the attribute, and a checkpoint in which it is read: fixture, name, module id."""


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_a_ray_without_an_attribute_is_refused_by_version(
    request: pytest.FixtureRequest, app: Path, notices: list[str], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    owner, fixture, checkpoint, module_id = ATTRIBUTES[name]
    files = locate_checkpoint(request.getfixturevalue(fixture) / checkpoint, module_id)

    def hide(piece: Any, attribute: str) -> Any:
        """Stand in for a Ray whose class names the attribute otherwise, only for us: RLlib's own code is unaffected."""
        renamed = attribute == name and owner in {kind.__name__ for kind in type(piece).__mro__}
        return getattr(piece, f"{name}_of_another_ray" if renamed else attribute)

    monkeypatch.setattr(private_names, "getattr", hide, raising=False)
    with user_code(app), pytest.raises(UnsupportedError) as refusal:
        restore(files, app, notices.append)
    assert f"Ray {ray.__version__} has no ray.rllib." in refusal.value.message
    assert f".{name}, without which" in refusal.value.message and private_names.KNOWN in refusal.value.message


def test_every_attribute_is_tried() -> None:
    attributes = {
        a for function, given in calls() if not function.endswith("find") for a in given if isinstance(a, str)
    }
    assert attributes == set(ATTRIBUTES)


def test_a_tune_without_its_registry_refuses_old_models_that_are_known_by_name(
    old_zoo: Path, app: Path, notices: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("ray.tune.registry._global_registry")
    with (
        user_code(app),
        pytest.raises(UnsupportedError, match=rf"Ray {ray.__version__} has no ray\.tune\.registry\._gl"),
    ):
        restore(locate_checkpoint(old_zoo / "named_model"), app, notices.append)


def test_a_configuration_without_a_setting_is_refused_and_not_given_one() -> None:
    class Configuration:
        pass

    with pytest.raises(UnsupportedError, match=r"has no .*Configuration\._env_to_module_connector, without which"):
        private_names.replace(Configuration(), "_env_to_module_connector", None)
    assert vars(Configuration()) == {}
