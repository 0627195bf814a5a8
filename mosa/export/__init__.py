"""A law as text for other programs: UMAT, UFL, Warp, JSON, each checked against this program's own kernels."""
