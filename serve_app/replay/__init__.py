"""Recordings against a bundle: what it would have done, and what return it would have earned."""
