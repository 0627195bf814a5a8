"""Gaussians that show a body as its images do."""
