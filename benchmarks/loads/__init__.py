"""What is published to a backend: synthetic streams, logs like the paper's, real logs."""
