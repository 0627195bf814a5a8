"""How a simulation asks an adapter for its stress."""
