"""Long provocation: what is wrong from outside, thousands of times, through the public interface.

``make fuzz`` runs all of it and prints a table; the test-suite has the short form of each.
"""
