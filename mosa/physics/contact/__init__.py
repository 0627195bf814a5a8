"""What a body meets: planes, and rigid colliders with their shapes, motions, kernels and reactions."""
