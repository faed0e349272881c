"""Formats and names that client and server must agree on."""
