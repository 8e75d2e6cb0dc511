"""Inference engines: sessions, the cache of prepared models, and loading a bundle."""
