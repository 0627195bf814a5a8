"""The grid: transfers from particles to nodes and back with their adjoints, and the window of nodes that a body needs."""
