"""Relative joint positions as targets, where the observation has the joints' present positions.

So Isaac Lab's own export (LEAPP) and its ROS node make them: target = observed position + relative action.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from gymnasium.spaces import Box

from rlservo.bundle.spaces import Element, Quantity
from rlservo.export.recipe.recipe import Present, Recipe
from rlservo.export.sources.restored_policy import ElementNames

RELATIVE: Quantity = "relative joint position"
TARGET: Quantity = "joint position"


def with_targets(recipe: Recipe, elements: ElementNames) -> tuple[Recipe, ElementNames]:
    """Return the recipe, and its elements, with targets [rad] in place of relative positions [rad] after its affine.

    The actions stay relative unless the observation has each joint's position once (a history is none), with a known
    scale and offset.
    """
    observed, actions = elements.observation, elements.action
    if not isinstance(observed, tuple) or not isinstance(actions, tuple) or not isinstance(recipe.action_space, Box):
        return recipe, elements
    relative = [element.quantity == RELATIVE for element in actions]
    found: list[int] = []
    for element, one in zip(actions, relative, strict=True):
        seen = [
            index
            for index, other in enumerate(observed)
            if one and other.quantity == TARGET and other.joint and other.joint == element.joint
        ]
        if one and (len(seen) != 1 or None in (observed[seen[0]].scale, observed[seen[0]].offset)):
            return recipe, elements
        found.append(seen[0] if one else 0)
    if not any(relative):
        return recipe, elements
    places = [observed[index] if one else Element(name="") for index, one in zip(found, relative, strict=True)]
    space = recipe.action_space
    bounds = (space.low, space.high) if recipe.transform == "clip" else (-np.inf, np.inf)
    present = Present(
        tuple(found),
        np.array([place.scale or 0.0 for place in places], np.float32),
        np.array([place.offset or 0.0 for place in places], np.float32),
        *(np.broadcast_to(np.float32(side), space.shape).copy() for side in bounds),
    )
    targets = tuple(
        element.model_copy(update={"quantity": TARGET}) if one else element
        for element, one in zip(actions, relative, strict=True)
    )
    unbounded = Box(-np.inf, np.inf, space.shape, np.float32)
    return (
        replace(recipe, action_space=unbounded, transform="none", present=present),
        replace(elements, action=targets),
    )
