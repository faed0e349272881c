"""Observation and action steps around a network as plain data, and sample observations to test them."""
