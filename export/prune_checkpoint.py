"""`rlservo prune`: copy out of a checkpoint only what an export needs, without the user's paths.

RLlib's own configuration pickles hold the training script's location and more, so they stay behind; their facts about
algorithm, environment and progress go into one JSON file.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from rlservo.errors import UsageError
from rlservo.export.checkpoints.facts import read_facts
from rlservo.export.checkpoints.location import FACTS_FILE, Files, locate_checkpoint
from rlservo.export.checkpoints.old_location import RLLIB_FILE
from rlservo.export.checkpoints.remote import fetch
from rlservo.export.checkpoints.unpickle import user_code
from rlservo.export.export_checkpoint import silent
from rlservo.export.sources.source import PICKLES


def prune_checkpoint(
    src: str | Path,
    dst: str | Path,
    *,
    module_id: str | None = None,
    app_dir: str | Path = ".",
    notify: Callable[[str], None],
) -> list[Path]:
    """Copy the module, both connector pipelines and the facts of checkpoint `src` to the new folder `dst`.

    Of an old-stack checkpoint the policy's state is copied unchanged: one pickle that also holds optimizer and
    settings, and cannot be split without becoming another file. The copy exports to the same policy, with the same
    hash; a new-stack one cannot be trained further (the optimizer stays behind). Returns the files kept, relative to
    `dst`. `notify` gets a sentence on what was kept, and on any file that names the home folder. Raises CheckpointError
    or UnsupportedError for `src`, UsageError when `dst` exists.
    """
    with fetch(src, silent) as local:
        return _prune(locate_checkpoint(local, module_id), Path(dst), app_dir, notify)


def _prune(files: Files, target: Path, app_dir: str | Path, notify: Callable[[str], None]) -> list[Path]:
    if target.exists():
        raise UsageError(f"{target} already exists: give a new folder to prune into")
    notify(f"loading {files.root}: {PICKLES}")
    with user_code(app_dir):
        facts = read_facts(files.root, notify)
    target.mkdir(parents=True)
    try:
        for file in files.files():
            copy = target / file.relative_to(files.root)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, copy)
        if (files.root / RLLIB_FILE).is_file():
            shutil.copyfile(files.root / RLLIB_FILE, target / RLLIB_FILE)
        (target / FACTS_FILE).write_text(facts.to_json(), encoding="utf-8")
    except BaseException:  # an interrupt must not leave half a checkpoint either
        shutil.rmtree(target, ignore_errors=True)
        raise
    kept = sorted(file for file in target.rglob("*") if file.is_file())
    size = sum(file.stat().st_size for file in kept)
    what = "the module, both connector pipelines" if files.api_stack == "new" else "the policy's state"
    notify(f"kept {len(kept)} files, {size / 1024:.0f} KiB: {what} and {FACTS_FILE}")
    for file in kept:
        if str(Path.home()).encode() in file.read_bytes():
            notify(f"{file} names the home folder {Path.home()}: look at it before publishing it")
    return [file.relative_to(target) for file in kept]
