"""Methods that the learned law is compared with."""
