"""Poses in files, in every format that is text or bytes alone; both sides read them here."""
