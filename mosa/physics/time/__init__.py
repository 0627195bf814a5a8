"""How many substeps a frame takes, and when."""
