"""Fuzz tests: thousands of faulty inputs through the public interface.

``make fuzz`` runs all kinds and prints a table; the test suite runs a short form of each.
"""
