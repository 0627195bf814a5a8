"""What a body looks like: its Gaussians, carried by its motion, in their light."""
