"""Tables of messages, in Arrow and in pandas."""
