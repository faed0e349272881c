"""Models and distributions registered by name, as RLlib's old documentation shows it."""

from __future__ import annotations

from old_zoo_parts import OldNamedModel
from ray.rllib.models import ModelCatalog
from zoo_rules import OldTanhGaussian, OldTempered


def register() -> None:
    ModelCatalog.register_custom_model("named_model", OldNamedModel)
    ModelCatalog.register_custom_action_dist("tanh_gaussian", OldTanhGaussian)
    ModelCatalog.register_custom_action_dist("tempered", OldTempered)
