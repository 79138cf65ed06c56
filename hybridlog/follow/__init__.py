"""What follows a recording beside its recorder, in a process of its own."""
