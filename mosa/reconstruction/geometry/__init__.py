"""The volume of a body from its outlines."""
