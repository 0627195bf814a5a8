"""Stress-strain tests of homogeneous specimens: any law fitted to them by the kernels that the simulator runs."""
