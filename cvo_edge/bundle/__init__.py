"""Bundles on disk: format, strict reading and writing, rules, signatures."""
