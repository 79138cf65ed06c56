"""Predicates over the fields of messages: one tree, and what is made of it."""
