"""Figures of a fitted body, and what they are compared with."""
