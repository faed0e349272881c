"""Request handling that all protocols share: admission, keys, settings, logs, metrics."""
