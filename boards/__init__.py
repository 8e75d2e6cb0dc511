"""Test the runtime on emulated processors and compare its results with this machine."""
