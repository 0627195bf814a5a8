"""The motion of particles through all frames."""
