"""The body that is learned: particles with a law and its parameters."""
