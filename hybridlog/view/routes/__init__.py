"""What the page asks the server for, a module a subject; each has `routes`."""
