"""HTTP routes of the view, a module a subject; each module has `routes`."""
