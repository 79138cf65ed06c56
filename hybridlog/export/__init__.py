"""Ways out of the store: files that other tools open."""
