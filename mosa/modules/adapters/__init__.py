"""What corrects the stress of the prior law."""
