"""The local page that shows a store: its server, and the page itself in `static/`."""
