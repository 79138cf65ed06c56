"""Message definitions and payloads: from bytes to columns, documents and objects.

Imports: columns.
"""
