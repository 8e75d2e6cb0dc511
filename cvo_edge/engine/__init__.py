"""Inference engines: sessions, the model cache, and loading a bundle."""
