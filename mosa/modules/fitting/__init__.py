"""How the numbers of a body are found: stages, optimisers, residuals, losses."""
