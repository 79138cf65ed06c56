"""Predicates over the fields of messages: one tree, and the forms it is translated to."""
