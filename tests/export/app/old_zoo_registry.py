"""Where this user registers a model by name, as RLlib's old documentation shows it."""

from __future__ import annotations

from old_zoo_parts import OldNamedModel
from ray.rllib.models import ModelCatalog


def register() -> None:
    ModelCatalog.register_custom_model("named_model", OldNamedModel)
