"""Messages, images and points as numpy arrays."""
