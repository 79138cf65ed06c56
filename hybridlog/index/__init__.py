"""The index in MongoDB: connecting, making and writing its documents.

Imports: maintenance, query, schema.
"""
