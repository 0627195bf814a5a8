"""The four networks of the stress adapter and their assembly as Triton kernels."""
