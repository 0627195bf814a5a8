"""Layouts of captures on disk."""
