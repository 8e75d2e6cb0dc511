"""The commands of ``cvo-edge``: one file a command, and what they measure."""
