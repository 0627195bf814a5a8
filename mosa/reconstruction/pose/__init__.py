"""Where a known body is, and how it starts."""
