"""Whether films, cameras and outlines agree with each other and with free fall."""
