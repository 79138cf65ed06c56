"""The local page that shows a store: its server, and the page itself in `static/`.

Imports: drawing, frames, live, query, record, schema.
"""
