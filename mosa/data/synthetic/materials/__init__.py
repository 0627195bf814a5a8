"""Hidden materials of the built-in scenes."""
