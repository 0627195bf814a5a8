"""Shapes of the built-in scenes."""
