"""Pictures read, undistorted, matted and brought to one size."""
