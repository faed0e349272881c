"""Location of a checkpoint's files: from the path a user gives to the folders the exporter reads.

File names are enough, so that a wrong path is reported before RLlib is imported or code in a checkpoint runs.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, TypeAlias

from rlservo.errors import CheckpointError, UnsupportedError
from rlservo.export.checkpoints.old_location import (
    DEFAULT_POLICY,
    OldStackFiles,
    choose,
    locate_policy,
    old_stack_root,
    policy_ids,
)
from rlservo.export.checkpoints.older_rays import OLD_WEIGHTS
from rlservo.export.checkpoints.unpickle import modules_named

MODULES = Path("learner_group") / "learner" / "rl_module"
TRAINING_RUNNER, EVALUATION_RUNNER = "env_runner", "eval_env_runner"
ENV_TO_MODULE = "env_to_module_connector"
MODULE_TO_ENV = "module_to_env_connector"
CTOR_FILE = "class_and_ctor_args.pkl"
STATE_STEMS = {"module": "module_state", "connector": "state"}
STATE_SUFFIXES = (".pkl", ".msgpack", ".pt")
LIBRARIES = (
    "ray.rllib.", "rlservo.export.rllib.batched_connectors.", "gymnasium.", "numpy.", "torch.", "builtins.",
    "collections.", "_codecs.",
)  # fmt: skip
"""Code of others in connector pipelines. What was pickled by value is made with cloudpickle's, which is not here."""
FACTS_FILE = "rlservo_facts.json"
"""Written by `prune.py` in place of RLlib's own configuration pickles."""

NO_CHECKPOINT = "is not an RLlib checkpoint"
_BEFORE_COMPONENTS = Path("learner") / "module_state"
_TUNE_CHECKPOINT = re.compile(r"checkpoint_(\d{6,})")


@dataclass(frozen=True)
class CheckpointFiles:
    """The folders of one policy in one new-stack algorithm checkpoint, or of one RLModule alone.

    The connector folders are in the local environment runner's, or at the root where training has only remote ones. An
    algorithm that trains from recorded data has none, or evaluation's.
    """

    api_stack: ClassVar[Literal["new"]] = "new"

    root: Path
    module_id: str
    alone: bool = False
    part: bool = False  # of a MultiRLModule that was saved by itself
    agent_id: str | None = None
    """The requested agent, if the module serves several."""

    @property
    def is_one_of_several(self) -> bool:
        """Whether the policy has an id of its own, and may have others next to it."""
        return self.module_id != DEFAULT_POLICY and (self.part or not self.alone)

    @property
    def module(self) -> Path:
        return self.root if self.alone else self.root / MODULES / self.module_id

    @property
    def runner(self) -> Path:
        """The folder that holds the connector pipelines: training's before evaluation's; it may not exist."""
        if (self.root / TRAINING_RUNNER).is_dir():
            return self.root / TRAINING_RUNNER
        if self.has_root_pipelines:
            return self.root
        evaluation = self.root / EVALUATION_RUNNER
        return evaluation if evaluation.is_dir() else self.root / TRAINING_RUNNER

    @property
    def has_root_pipelines(self) -> bool:
        """Whether training had only remote environment runners, whose merged connectors RLlib saves at the root."""
        return any((self.root / name).is_dir() for name in (ENV_TO_MODULE, MODULE_TO_ENV))

    @property
    def has_pipelines(self) -> bool:
        """Whether the checkpoint holds the connector pipelines with their learned statistics.

        An environment runner that talks to an environment elsewhere has none.
        """
        return any((self.runner / name).is_dir() for name in (ENV_TO_MODULE, MODULE_TO_ENV))

    @property
    def is_of_evaluation(self) -> bool:
        """Whether only evaluation has filled the statistics of the connector pipelines."""
        return self.runner == self.root / EVALUATION_RUNNER

    @property
    def env_to_module(self) -> Path:
        return self.runner / ENV_TO_MODULE

    @property
    def module_to_env(self) -> Path:
        return self.runner / MODULE_TO_ENV

    def files(self) -> list[Path]:
        """Return every file that affects the policy, in a fixed order."""
        folders = (self.module, self.env_to_module, self.module_to_env)
        found = {file for folder in folders for file in folder.rglob("*") if file.is_file()}
        early = weights_pickle(self.module).name == OLD_WEIGHTS
        if (early or not self.has_pipelines) and not self.alone:
            found.add(self.root / CTOR_FILE)  # the configuration they are built from
        if (self.has_own_connectors or self._has_own([self.module])) and (self.root / CTOR_FILE).is_file():
            found.add(self.root / CTOR_FILE)  # RLlib often records their arguments wrongly, and restores by it
        if self.is_one_of_several and self.together.is_file():
            found.add(self.together)
        return sorted(found)

    @property
    def has_own_connectors(self) -> bool:
        """Whether any code in the connector pipelines is the user's own."""
        return self._has_own([self.env_to_module, self.module_to_env])

    def _has_own(self, folders: list[Path]) -> bool:
        pickles = [folder / CTOR_FILE for folder in folders]
        named = {module for file in pickles if file.is_file() for module in modules_named(file)}
        return not all(f"{module}.".startswith(LIBRARIES) for module in named)

    @property
    def together(self) -> Path:
        """The file that names the class that holds the modules."""
        return self.root / MODULES / CTOR_FILE

    def sha256(self) -> str:
        """Return a hash over those files' names and contents: the same for a checkpoint and its pruned copy."""
        digest = hashlib.sha256()
        for file in self.files():
            digest.update(file.relative_to(self.root).as_posix().encode() + b"\0")
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        return digest.hexdigest()


Files: TypeAlias = CheckpointFiles | OldStackFiles
"""Location of one policy, on either API stack."""


def locate_checkpoint(path: str | Path, module_id: str | None = None, agent_id: str | None = None) -> Files:
    """Return the files of one policy.

    `path` may be an algorithm checkpoint of either API stack, a folder inside one (such as its RLModule or policy
    folder), an old-stack policy's folder on its own, or a Tune trial folder, of which the newest `checkpoint_NNNNNN` is
    taken.

    Raises CheckpointError when there is nothing to read, UnsupportedError when it is of a kind that is not exported.
    """
    given = Path(path).expanduser().absolute()
    if not given.exists():
        raise CheckpointError(f"{given} does not exist: expected the folder of an RLlib checkpoint")
    if not given.is_dir():
        raise CheckpointError(f"{given} is a file: expected the folder of an RLlib checkpoint")
    root = _find_root(given)
    if _is_module(root):
        parts = _parts(root)
        if parts:
            module_id = choose(root, parts, module_id, "module", "modules")
            root /= module_id
        alone = CheckpointFiles(root, module_id or DEFAULT_POLICY, alone=True, part=bool(parts))
        _check_complete(alone)
        return alone
    if not (root / MODULES).is_dir():
        if agent_id is not None:
            raise CheckpointError(f"{root} is of the old API stack, where all agents of a policy share one filter: "
                                  "leave --agent-id out")  # fmt: skip
        return locate_policy(root, given, module_id)
    if root != given and (root / MODULES) in given.parents and module_id is None:
        module_id = given.relative_to(root / MODULES).parts[0]
    files = CheckpointFiles(root, _choose_module(root, module_id), agent_id=agent_id)
    _check_complete(files)
    return files


def is_known(path: Path, stack: type[Files]) -> bool:
    """Return whether `path` is RLlib's, of this API stack; one that only an older Ray could read counts as new."""
    if not path.is_dir():
        return False
    try:
        root = _find_root(path)
    except UnsupportedError:
        return stack is CheckpointFiles
    except CheckpointError as error:
        return stack is CheckpointFiles and NO_CHECKPOINT not in error.message
    is_new = _is_module(root) or (root / MODULES).is_dir()
    return stack is (CheckpointFiles if is_new else OldStackFiles)


def locate_modules(path: str | Path) -> list[Files]:
    """Return the files of every policy of a checkpoint, by module id (old API stack: policy id).

    Raises the errors of `locate_checkpoint`.
    """
    given = Path(path).expanduser().absolute()
    root = _find_root(given) if given.is_dir() else given
    ids = _present_modules(root) or policy_ids(root) or (_parts(root) if root.is_dir() else [])
    return [locate_checkpoint(root, module_id) for module_id in ids] or [locate_checkpoint(given)]


def _find_root(given: Path) -> Path:
    """Return the algorithm checkpoint that `given` is, is in, or holds."""
    for folder in (given, *given.parents):
        if (folder / MODULES).is_dir():
            return folder
    if (given / _BEFORE_COMPONENTS).is_dir() and not policy_ids(given):  # RLModules inside old policies have both
        raise UnsupportedError(
            f"{given} holds its modules in {_BEFORE_COMPONENTS}/, as a Ray before 2.33 wrote them on the new API "
            "stack: without the connectors and what they had learned, such as an observation filter's statistics; "
            "train again with a later Ray and export that"
        )
    if old := old_stack_root(given):
        return old
    if newest := _newest_checkpoint(given):
        return _find_root(newest)
    if _is_module(given):
        return given
    trials = [trial for trial in sorted(given.iterdir()) if trial.is_dir() and _newest_checkpoint(trial)]
    if len(trials) == 1:
        return _find_root(trials[0])
    if trials:
        names = ", ".join(trial.name for trial in trials[:4]) + (", ..." if len(trials) > 4 else "")
        raise CheckpointError(f"{given} holds {len(trials)} trials with checkpoints ({names}): name one of them")
    raise CheckpointError(
        f"{given} {NO_CHECKPOINT}: looked for {MODULES}/ (an algorithm checkpoint of the new API stack), policies/ "
        "(the old stack) and checkpoint_NNNNNN/ (a Tune trial), and found none of them"
    )


def weights_pickle(folder: Path) -> Path:
    """Return the file that holds a module's weights, as older Rays or as today's name it; it may not exist."""
    older = folder / OLD_WEIGHTS
    return older if older.is_file() else folder / f"{STATE_STEMS['module']}.pkl"


def _is_module(folder: Path) -> bool:
    """Return whether `folder` is an RLModule that was saved, or copied, by itself."""
    return any((folder / f"{STATE_STEMS['module']}{suffix}").is_file() for suffix in STATE_SUFFIXES)


def _parts(folder: Path) -> list[str]:
    """Return the modules in the folder of a MultiRLModule that was saved by itself."""
    return sorted(child.name for child in folder.iterdir() if child.is_dir() and _is_module(child))


def _newest_checkpoint(folder: Path) -> Path | None:
    numbered = [
        (int(match[1]), child)
        for child in folder.iterdir()
        if (match := _TUNE_CHECKPOINT.fullmatch(child.name)) and child.is_dir()
    ]
    return max(numbered)[1] if numbered else None


def _present_modules(root: Path) -> list[str]:
    folder = root / MODULES
    return sorted(child.name for child in folder.iterdir() if (child / CTOR_FILE).is_file()) if folder.is_dir() else []


def _choose_module(root: Path, module_id: str | None) -> str:
    present = _present_modules(root)
    if not present and module_id is None:
        raise CheckpointError(f"{root / MODULES} holds no module: looked for <module id>/{CTOR_FILE}")
    return choose(root, present, module_id, "module", "modules")


def _check_complete(files: CheckpointFiles) -> None:
    if (files.module / "state.pkl").is_file() and not _is_module(files.module):
        raise UnsupportedError(
            f"{files.module} holds its weights in state.pkl, as Ray 2.33 and a few later releases wrote them; today's "
            "RLlib looks for module_state.pkl and cannot restore them: train again with a later Ray and export that"
        )
    needed = [(files.module, STATE_STEMS["module"], "the weights")]
    pipelines = (
        (files.env_to_module, STATE_STEMS["connector"], "the observation filter and other steps before the network"),
        (files.module_to_env, STATE_STEMS["connector"], "the action scaling and other steps after the network"),
    )
    if (files.root / TRAINING_RUNNER).is_dir() and files.has_root_pipelines:
        raise CheckpointError(
            f"{files.root} has connectors both in {TRAINING_RUNNER}/ and at its root, saved by two training runs: "
            "only one of them belongs to the weights; remove the other"
        )
    if files.has_pipelines:
        needed += pipelines
    elif not files.alone and not (files.root / CTOR_FILE).is_file():
        raise CheckpointError(
            f"{files.root} is incomplete: it has neither {TRAINING_RUNNER}/ (the connector pipelines) nor "
            f"{CTOR_FILE} (the configuration they are built from)"
        )
    for folder, stem, what in needed:
        for present, name in (
            ((folder / CTOR_FILE).is_file(), CTOR_FILE),
            (any((folder / f"{stem}{suffix}").is_file() for suffix in STATE_SUFFIXES), f"{stem}.pkl"),
        ):
            if not present:
                raise CheckpointError(f"{files.root} is incomplete: {folder.relative_to(files.root) / name} ({what})")
