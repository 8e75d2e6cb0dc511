"""Output of estimates: sinks, and reading recorded files back."""
