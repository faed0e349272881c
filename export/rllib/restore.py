"""Restoring of a checkpoint of either API stack into the form that the exporter works with."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from rlservo.export.checkpoints.location import Files
from rlservo.export.checkpoints.old_location import OldStackFiles
from rlservo.export.recipe.describe import unexpected_steps
from rlservo.export.rllib import quick_import
from rlservo.export.rllib.filter_statistics import why_untrained
from rlservo.export.rllib.supported_spaces import check_unsquashing
from rlservo.export.sources.restored_policy import RestoredPolicy


def restore(files: Files, app_dir: Path, notify: Callable[[str], None], *, value: bool = True) -> RestoredPolicy:
    """Restore one policy; the user's own classes are in `app_dir`. `value` False leaves the value head out.

    Starts nothing: no `ray.init`, no environment, no worker. Raises CheckpointError when the policy cannot be read,
    UnsupportedError when exporting it would lose something.
    """
    # Imported here: a Ray without the old API stack continues reading the new one's checkpoints.
    if isinstance(files, OldStackFiles):
        from rlservo.export.rllib.old_stack.policy import restore_old_stack

        restored = restore_old_stack(files, app_dir, notify, value=value)
    else:
        quick_import.import_needed()
        from rlservo.export.rllib.new_stack.policy import restore_new_stack

        restored = restore_new_stack(files, notify, value=value)
    check_unsquashing(restored.recipe.action_space, restored.recipe.transform)
    for sentence in unexpected_steps(restored.recipe):
        notify(sentence)
    return dataclasses.replace(restored, untrained_filter=why_untrained(files, restored.recipe))
