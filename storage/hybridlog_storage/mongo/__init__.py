"""The embedded MongoDB, connections to it, and the collections of a store. Imports: disk."""
