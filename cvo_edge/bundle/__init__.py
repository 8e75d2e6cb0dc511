"""A bundle on disk: its format, strict reading and writing, rules and signature."""
