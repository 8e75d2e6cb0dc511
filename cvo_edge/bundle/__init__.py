"""Bundles on disk: format, strict reading and writing, consistency rules, signatures."""
