"""Recordings against a bundle: its actions, and an estimate of its return."""
