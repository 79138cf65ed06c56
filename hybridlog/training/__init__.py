"""Training sets for robot learning, from recordings.

Imports: across, arrays, drawing, formats, query, schema.
"""
