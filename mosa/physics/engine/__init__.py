"""What advances a body: the simulator, its differentiable operations, buffers, captured graphs and time steps."""
