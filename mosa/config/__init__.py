"""What a run is asked for: configurations composed, checked, made into objects, and read back from checkpoints."""
