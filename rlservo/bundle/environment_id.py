"""Gymnasium ids of our own environments, with and without the module that registers them."""

from __future__ import annotations

NAMESPACE = "rlservo"
MODULE = "rlservo.envs:"


def importing_id(env_id: str) -> str:
    """Return the id as `gym.make` takes it without importing our environments first; others' unchanged."""
    return f"{MODULE}{env_id}" if env_id.startswith(f"{NAMESPACE}/") else env_id


def plain_id(env_id: str) -> str:
    """Return the id for contracts and reports: ours without its module."""
    return env_id.removeprefix(MODULE)
