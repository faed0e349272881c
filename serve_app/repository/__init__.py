"""Bundles by name and version, in folders and object storage: found, fetched by hash, cached, published."""
