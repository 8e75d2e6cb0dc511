"""Inference engines: sessions, the cache of prepared models, and opening a bundle with them."""
