"""Tables of messages, in Arrow and in pandas. Imports: columns, formats, index, query, schema."""
