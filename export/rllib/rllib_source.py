"""Sources of RLlib's two API stacks. They share the search for files, and import RLlib only to restore."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, cast

from rlservo.errors import CheckpointError
from rlservo.export.checkpoints.facts import CheckpointFacts, read_facts
from rlservo.export.checkpoints.location import CheckpointFiles, Files, is_known, locate_checkpoint, locate_modules
from rlservo.export.checkpoints.old_location import OldStackFiles
from rlservo.export.sources.restored_policy import RestoredPolicy
from rlservo.export.sources.source import Notify, PolicyFiles, RestoreOptions, Source


class NewStack(Source):
    """Checkpoints of the new API stack: an algorithm's, an RLModule's, a Tune trial's."""

    name = "rllib"
    framework = "RLlib"
    distribution = "ray"
    extra = "train"
    packages = ("ray",)
    expects = "an RLlib checkpoint's folder, or a Tune trial's"
    reference = (
        "RLlib's own connectors, as Algorithm.from_checkpoint builds them from the configuration and sets their saved "
        "state, around its own inference forward, step after step, observation filter frozen, exploration off"
    )
    stack: ClassVar[type[Files]] = CheckpointFiles

    def detects(self, path: Path) -> bool:
        return is_known(path, self.stack)

    def locate(self, path: Path, module_id: str | None, agent_id: str | None) -> PolicyFiles:
        return self._own(locate_checkpoint(path, module_id, agent_id))

    def locate_all(self, path: Path) -> Sequence[PolicyFiles]:
        return [self._own(files) for files in locate_modules(path)]

    def facts(self, files: PolicyFiles, notify: Notify) -> CheckpointFacts:
        return read_facts(files.root, notify)

    def restore(self, files: PolicyFiles, options: RestoreOptions, notify: Notify) -> RestoredPolicy:
        from rlservo.export.rllib.restore import restore

        return restore(cast(Files, files), options.app_dir, notify, value=options.value)

    def _own(self, files: Files) -> Files:
        if not isinstance(files, self.stack):
            raise CheckpointError(f"{files.root} is of RLlib's {files.api_stack} API stack: leave --source out")
        return files


class OldStack(NewStack):
    """Checkpoints of the old API stack: an algorithm's or a policy's."""

    name = "rllib-old"
    expects = "a checkpoint of RLlib's old API stack"
    reference = (
        "RLlib's own agent connectors, compute_actions_from_input_dict and action connectors (old API stack), "
        "restored from the checkpoint, observation filter frozen, exploration off"
    )
    stack = OldStackFiles
