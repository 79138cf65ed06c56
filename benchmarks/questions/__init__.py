"""What is asked of a backend that holds a load, in its own language."""
