"""Where estimates go: sinks, and reading recorded files back."""
