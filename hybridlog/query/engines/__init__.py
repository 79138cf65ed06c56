"""The ways of answering a part of a question; they all give the same answer."""
