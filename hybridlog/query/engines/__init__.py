"""The engines that answer parts of a question; all give the same answer."""
