"""Closed-loop runs of a policy in a Gymnasium environment: fallback actions, report, video."""
